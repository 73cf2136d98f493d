"""The robustness card: what policies withstand, as numbers, tables and pictures."""

from __future__ import annotations

import dataclasses
import html
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.files import another_format, check_texts, csv_content, write_whole
from quadrl.base.media import Media
from quadrl.base.units import quantity
from quadrl.evaluation.cache import ResultCache
from quadrl.evaluation.evaluate import html_table
from quadrl.evaluation.rollout import BEHAVIOUR

NORMAL_95 = 1.959963984540054  # the normal distribution's quantile of 97.5 %
QUARTILES = (0.25, 0.5, 0.75)
FORMAT = "quadrl-robustness-1"
FILE, RECOVERY = "robustness", "recovery"
"""What the files of a card are called, and the pictures of its maps, without their endings."""
KINDS = ("png", "pdf")
"""What these endings are, of pictures."""


def wilson(successes: float, flights: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927), from successes out of some flights."""
    share, square = successes / flights, NORMAL_95**2 / flights
    middle = (share + square / 2) / (1 + square)
    half = NORMAL_95 * math.sqrt((share * (1 - share) + square / 4) / flights) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def half_level(levels: Sequence[float], shares: Sequence[float | None]) -> float | None:
    """Where half of the flights fail, interpolated between two levels.

    Args:
        levels: From where nothing is disturbed outwards.
        shares: Shares of the flights that succeed; None for a level at which no aircraft can hover.

    Returns:
        The level, the first one if half fail there already; None where no level takes half.
    """
    if shares[0] is not None and shares[0] < 0.5:
        return levels[0]
    known = [(x, y) for x, y in zip(levels, shares, strict=True) if y is not None]
    for (near, high), (far, low) in zip(known[:-1], known[1:], strict=True):
        if low < 0.5:
            return near + (far - near) * (high - 0.5) / (high - low)
    return None


@dataclasses.dataclass(frozen=True, repr=False)
class Card:
    """What policies withstand, beside each other; a table and pictures in a notebook."""

    found: dict[str, Any]
    """As the JSON file has it: task, vehicle, seed, episodes, engine; `flown`, the names, and
    `scenarios` by name; in `axes` by disturbance its levels and, for each that flew, `success`,
    its 95 % interval `low` and `high`, quartiles of the error over the last 2 s `error_m`, what
    `quadrl.evaluation.rollout.BEHAVIOUR` names (None where the task does not ask for it), and
    `half`, the levels under and over the usual one at which half of the flights fail, and `reach`,
    for each that flew those from which on no policy can hover within its actions; by recovery map
    the shares of the flights that recover."""
    kept: ResultCache | None = dataclasses.field(default=None, compare=False)
    """What was kept of the flights until the card is saved."""

    def __repr__(self) -> str:
        found = self.found
        return (
            f"robustness of {', '.join(found['flown'])} on {found['task']}: "
            f"{len(found['axes'])} disturbances, {found['episodes']} flights a level"
        )

    def _repr_html_(self) -> str:
        pictures = [self.figure, *([self.maps] if self.found["recovery"] else [])]
        text = html_table(self.table) + f"<p>{html.escape(self.reach)}</p>"
        return text + "".join(one._repr_html_() for one in pictures)

    @property
    def table(self) -> list[tuple[str, ...]]:
        """Where half of the flights fail, a row for each disturbance; the first row is the head.

        The last rows say how fast the aircraft turn and circle where nothing disturbs them.
        """
        flown = self.found["flown"]
        rows: list[tuple[str, ...]] = [("half of the flights fail at", *flown)]
        for axis in self.found["axes"].values():
            cells = (half_words(axis, axis["flown"][name]["half"]) for name in flown)
            rows.append((f"{axis['label']} [{axis['unit']}]", *cells))
        for axis in [*self.found["axes"].values()][:1]:
            k = axis["levels"].index(axis["usual"])
            for metric, word in (("yaw_rate_rad_s", "turning"), ("circling_m_s", "circling")):
                values = [axis["flown"][name][metric][k] for name in flown]
                if values != [None] * len(flown):
                    cells = (quantity(metric, "" if x is None else x) for x in values)
                    rows.append((f"{word}, undisturbed", *cells))
        return rows

    @property
    def reach(self) -> str:
        """From which levels on no policy can hover within its actions; empty if at none."""
        said = []
        for axis in self.found["axes"].values():
            alike: dict[str, list[str]] = {}
            for name, ends in axis["reach"].items():
                words = zip(("under", "over"), ends, strict=True)
                given = " or ".join(f"{word} {end:.3g}" for word, end in words if end is not None)
                alike.setdefault(given, []).append(name)
            limits = (f"{given} ({', '.join(names)})" for given, names in alike.items() if given)
            if text := ", ".join(limits):
                said.append(f"{axis['label']} [{axis['unit']}] {text}")
        return f"no policy can hover level and still: {'; '.join(said)}" if said else ""

    @property
    def figure(self) -> Media:
        """Success and error over every disturbance."""
        return self._picture(FILE)

    @property
    def maps(self) -> Media:
        """The recovery maps.

        Raises:
            QuadrlError: None were flown.
        """
        if not self.found["recovery"]:
            raise QuadrlError("there are no recovery maps: recovery was False")
        return self._picture(RECOVERY)

    def save(self, folder: str | Path) -> list[Path]:
        """Write numbers (.json, .csv) and pictures (.png, .pdf) into a folder; returns the paths.

        The pictures of the recovery maps are called recovery.png and recovery.pdf.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"format": FORMAT, **self.found}, indent=1, allow_nan=False) + "\n"
        contents = {f"{FILE}.json": text.encode(), f"{FILE}.csv": csv_content(self._rows())}
        for name in [FILE, *[RECOVERY] * bool(self.found["recovery"])]:
            for kind, picture in zip(KINDS, self._drawn(name, *KINDS), strict=True):
                contents[f"{name}.{kind}"] = picture
        for name, content in contents.items():
            write_whole(folder / name, content)
        if self.kept:
            self.kept.forget()
        return [folder / name for name in contents]

    @classmethod
    def load(cls, path: str | Path) -> Card:
        """Read what `save` wrote: the folder, or its .json file.

        Raises:
            QuadrlError: There is no such file, or it is something else.
        """
        path = Path(path)
        file = path / f"{FILE}.json" if path.is_dir() else path
        try:
            found = json.loads(file.read_text())
            check_texts(found)
            written = found.pop("format", None)
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise QuadrlError(f"{file} holds no robustness card: {error}") from error
        if written != FORMAT:
            raise another_format(file, written, FORMAT)
        return cls(found)

    def _picture(self, name: str) -> Media:
        return Media(self._drawn(name, "png")[0], "png", lambda kind: self._drawn(name, kind)[0])

    def _drawn(self, name: str, *kinds: str) -> list[bytes]:
        """One of its pictures, as files of some kinds."""
        with needed("a card"):
            from quadrl.evaluation import card_figures, plotting  # they take a second

        draw = card_figures.maps if name == RECOVERY else card_figures.card
        figure = draw(self.found)
        return [plotting.content(figure, kind) for kind in kinds]

    def _rows(self) -> Iterator[Sequence[Any]]:
        """The numbers as a table: a row for each level that each flew."""
        quartiles = [f"error_{round(100 * q)}_m" for q in QUARTILES]
        shares, rest = ("success", "low", "high"), BEHAVIOUR
        yield ("disturbance", "unit", "flown", "level", *shares, *quartiles, *rest)
        for name, axis in self.found["axes"].items():
            for flown, reached in axis["flown"].items():
                for k, level in enumerate(axis["levels"]):
                    errors = reached["error_m"][k] or ["", "", ""]
                    known = (reached[which][k] for which in shares)
                    ways = (reached[which][k] for which in rest)
                    yield [name, axis["unit"], flown, level, *known, *errors, *ways]


def half_words(axis: Mapping[str, Any], half: Sequence[float | None]) -> str:
    """Where half of the flights fail, in words."""
    low, high = half
    over = f"over {axis['levels'][-1]:g}" if high is None else f"{high:.3g}"
    if axis["usual"] == axis["levels"][0]:
        return over
    under = f"under {axis['levels'][0]:g}" if low is None else f"{low:.3g}"
    return f"{under}, {over}"
