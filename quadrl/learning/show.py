"""Pictures and videos that show themselves in a notebook."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.media import Media
from quadrl.base.progress import ProgressBar
from quadrl.base.validation import choice
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task
from quadrl.evaluation.evaluate import Evaluation, beside, evaluate
from quadrl.learning import phases
from quadrl.learning.folder import read_config
from quadrl.learning.foreign import read_curve
from quadrl.rendering.scenarios import comment
from quadrl.rendering.sheet import SHEETS, write_contact_sheet
from quadrl.rendering.video import VIDEOS, write_video

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PICTURES: dict[str, dict[str, Any]] = {
    "mp4": {"width": 848, "height": 480, "fps": 20.0},
    "gif": {"width": 640, "height": 360, "fps": 12.5},
    "sheet": {"width": 480, "height": 270, "fps": 20.0},
}
"""What a kind of file is drawn with by default: width and height [pixels], frames a second."""


def render(
    controller: Any,
    task: str | Task | Scenario | None = None,
    *,
    seed: int = 0,
    kind: str = "mp4",
    camera: str = "follow",
    width: int | None = None,
    height: int | None = None,
    fps: float | None = None,
    speed_trail: bool = False,
    progress: bool = True,
    **conditions: Unpack[Conditions],
) -> Media:
    """Draw a flight of a policy or a controller, or of several; `quadrl render` in Python.

    Args:
        controller: A policy or a controller, as `quadrl.evaluate` takes it; or a mapping of labels
            to several, which fly the same episode and are shown side by side.
        task: A task or its name, or a whole scenario; by default the task that the (first) policy
            was trained for.
        seed: Seed of the episode.
        kind: "mp4" or "gif"; or "png" or "jpg" for moments of the flight in one picture.
        camera: "follow" keeps the goal in view, "chase" is behind the aircraft; or a camera of the
            model.
        width: Width of a picture [pixels]; by default 848, 640 for gif, 480 for png and jpg. Each
            of several flights has a picture of this size.
        height: Height of a picture [pixels]; by default 480, 360 for gif, 270 for png and jpg.
        fps: Frames a second; by default 20, and 12.5 for gif.
        speed_trail: Whether to show the whole path so far, coloured by speed.
        progress: Whether to show a progress bar.
        **conditions: As `quadrl.evaluate` takes them.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
        RenderingUnavailable: There is no graphics library.
    """
    sheet = choice("kind", kind, (*VIDEOS, *SHEETS)) in SHEETS
    asked = {"width": width, "height": height, "fps": fps}
    picture: dict[str, Any] = PICTURES["sheet" if sheet else kind] | {
        name: value for name, value in asked.items() if value is not None
    }
    picture["speed_trail"] = speed_trail
    several = controller if isinstance(controller, Mapping) else {"": controller}
    flown = [
        evaluate(one, scenario, episodes=1, seed=seed)
        for one, scenario in beside(several.values(), task, **conditions)
    ]
    flights = [one.trajectory() for one in flown]
    models = [one.scenario.compile_model() for one in flown]
    write = write_contact_sheet if sheet else write_video
    with ProgressBar(lines=False) as bar, tempfile.TemporaryDirectory() as folder:
        if progress:
            picture["on_frame"] = lambda done, total: bar.update(done, total, "drawing")
        path = Path(folder, f"flight.{kind}")
        write(flights, models, path, label=[*several], camera=camera, **picture)
        return Media(path.read_bytes(), kind)


def plot(*what: Any, kind: str = "png") -> Media:
    """Draw the learning curves of a run or of several, or the flights of an evaluation.

    Args:
        *what: What `quadrl.train` returned, or run folders; or one thing that `quadrl.evaluate`
            returned. Several runs must be of one task; there is a curve for each algorithm, with
            the spread over its runs. A csv is the curve of another program beside them
            (`quadrl.learning.foreign.read_curve`).
        kind: Kind of the picture: "png", "pdf", "svg" or another that matplotlib knows.

    Raises:
        QuadrlError: There is nothing to draw, the runs are of several tasks, or the kind is
            unknown.
    """
    with needed("quadrl.plot"):
        from quadrl.evaluation import flight_figures, plotting

    if not what:
        raise QuadrlError("give runs, run folders, or an evaluation")
    flown = [one for one in what if isinstance(one, Evaluation)]
    if flown and len(what) > 1:
        raise QuadrlError("give one evaluation at a time")
    figures = {repr(one): flight_figures.trajectory(one.rollout, repr(one)) for one in flown}
    folders = [Path(getattr(one, "folder", one)) for one in what if not flown]
    if len(folders) == 1 and folders[0].suffix != ".csv":
        figures |= {str(one): curve(one) for one in folders}
    elif folders:
        figures |= curves(folders)
    if len(figures) > 1:
        allowed = "one for all runs of a picture"
        raise QuadrlError(name="task", value=sorted(figures), allowed=allowed)
    (figure,) = figures.values()
    carried = comment(one.scenario.to_json() for one in flown) if flown else ""

    def make(kind: str) -> bytes:
        return plotting.content(figure, kind, comment=carried)

    return Media(make(kind), kind, make)


def curve(folder: Path) -> Figure:
    """Draw the learning curve of a run.

    Raises:
        QuadrlError: The folder holds no run with metrics.
    """
    from quadrl.evaluation import plotting

    config, (metrics, evaluated, ends) = read_config(folder), phases.curve(folder)
    title = f"{config['task']}, {str(config['algo']).upper()}, seed {config['seed']}"
    return plotting.learning_curve(metrics, title, evaluated, ends)


def curves(
    folders: Iterable[Path] | Mapping[Path, str],
    on_missing: Callable[[QuadrlError], None] | None = None,
    clocks: Sequence[str] = ("steps", "seconds"),
) -> dict[str, Figure]:
    """Draw the learning curves of several runs: a figure for each task, a curve for each label.

    They are of the mean action where all runs of a task were evaluated along the training, else of
    the sampled actions. Curves of other programs are drawn beside those of each task.

    Args:
        folders: Folders of the runs, perhaps with a label each; by default that is the algorithm.
            A csv is a curve of another program (`quadrl.learning.foreign.read_curve`), labelled by
            its name without the ending.
        on_missing: Called with the error about a folder without metrics, or about a task of which
            no episode has ended; they are then left out.
        clocks: Names of `plotting.CLOCKS`, a row of each figure for each.

    Raises:
        QuadrlError: There is such a folder or task, and `on_missing` is None.
    """
    from quadrl.evaluation import plotting

    runs: dict[str, dict[str, list[tuple[Any, Any]]]] = {}
    others: dict[str, list[Any]] = {}
    figures: dict[str, Figure] = {}

    @contextlib.contextmanager
    def told() -> Generator[None]:
        try:
            yield
        except QuadrlError as error:
            if on_missing is None:
                raise
            on_missing(error)

    for folder in folders:
        with told():
            if folder.suffix == ".csv":
                read = read_curve(folder)
                others.setdefault(folder.stem, []).append(read)
                continue
            config, both = read_config(folder), phases.curve(folder)[:2]
            label = folders[folder] if isinstance(folders, Mapping) else config["algo"]
            runs.setdefault(config["task"], {}).setdefault(label, []).append(both)
    for task, found in runs.items():
        mean = all(evaluated for pairs in found.values() for _, evaluated in pairs)
        groups = {label: [pair[mean] for pair in pairs] for label, pairs in found.items()}
        with told():
            flown = "mean action" if mean else "sampled actions"
            title = f"{task}, {flown}{' of the runs' * bool(others)}"
            figures[task] = plotting.learning_curves(groups | others, title, clocks)
    if others and not runs:
        figures["others"] = plotting.learning_curves(others, "learning curves", clocks)
    return figures
