// Plots over time, on a canvas each.

const SPAN = 12; // [s] that a plot shows at least
const RULES = "rgba(140, 170, 200, 0.13)", TEXT = "#7f93a8";
const LEFT = 40, RIGHT = 10, TOP = 8, BOTTOM = 20; // [px]

// A step that divides a range into about `count` parts, of 1, 2 or 5 times a power of ten.
function nice(range, count) {
  const power = 10 ** Math.floor(Math.log10(range / count));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => range / step <= count);
}

export class Plot {
  // from: the lowest value that is shown, by default that of the lines; least: how much is shown at least.
  constructor(canvas, { from, least }) {
    Object.assign(this, { canvas, from, least });
  }

  // lines: { colour, width, points: [[time, value]] }; marks: times of events.
  draw(lines, until, marks) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const end = Math.max(until, SPAN), begin = end - SPAN;
    const shown = lines.map((line) => ({ ...line, points: line.points.filter(([time]) => time >= begin - 0.1) }));
    const [low, high] = this.#range(shown.flatMap(({ points }) => points.map(([, value]) => value)));
    const x = (time) => LEFT + ((time - begin) / SPAN) * (width - LEFT - RIGHT);
    const y = (value) => height - BOTTOM - ((value - low) / (high - low)) * (height - TOP - BOTTOM);
    const stroke = (points) => {
      context.beginPath();
      points.forEach((point, k) => (k ? context.lineTo(...point) : context.moveTo(...point)));
      context.stroke();
    };
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = TEXT;
    context.strokeStyle = RULES;
    context.lineWidth = 1;
    const step = nice(high - low, height > 130 ? 4 : 3), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    context.textAlign = "right";
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      stroke([[LEFT, y(value)], [width - RIGHT, y(value)]]);
      context.fillText(value.toFixed(digits), LEFT - 6, y(value) + 4);
    }
    context.textAlign = "center";
    const every = nice(SPAN, width / 60);
    for (let time = Math.ceil(begin / every) * every; time <= end; time += every) {
      const place = Math.min(Math.max(x(time), LEFT + 8), width - RIGHT - 12);
      context.fillText(`${+time.toFixed(1)} s`, place, height - 5);
    }
    context.strokeStyle = "rgba(255, 214, 102, 0.55)";
    context.setLineDash([3, 3]);
    for (const time of marks.filter((mark) => mark >= begin)) stroke([[x(time), TOP], [x(time), height - BOTTOM]]);
    context.setLineDash([]);
    context.save();
    context.beginPath();
    context.rect(LEFT, 0, width - LEFT - RIGHT, height);
    context.clip();
    context.lineJoin = "round";
    for (const { colour, points, width: thickness } of shown) {
      context.strokeStyle = colour;
      context.lineWidth = thickness;
      stroke(points.map(([time, value]) => [x(time), y(value)]));
    }
    context.restore();
  }

  // The lowest and the highest value that are shown, with some room around the given ones.
  #range(values) {
    const fixed = this.from !== undefined;
    let low = this.from ?? Math.min(...values), high = Math.max(...values);
    if (high - low < this.least) {
      const middle = fixed ? low + this.least / 2 : (high + low) / 2;
      [low, high] = [middle - this.least / 2, middle + this.least / 2];
    }
    high += 0.06 * (high - low);
    return [fixed ? low : low - 0.06 * (high - low), high];
  }
}
