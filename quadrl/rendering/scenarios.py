"""The scenarios that videos and pictures of flights carry: as JSON, in the comment of the file."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError, RenderingUnavailable
from quadrl.base.files import check_texts
from quadrl.core.record import warn_of_changes
from quadrl.core.scenario import Scenario
from quadrl.rendering.overlay import require

COMMENT = "comment"
"""The name of the text in a file."""
LONGEST_BLOCK = 255  # [bytes], of a GIF


def comment(scenarios: Iterable[Mapping[str, Any]]) -> str:
    """Text for a file: a list of the scenarios of its flights, as `Scenario.to_json` gives them."""
    return json.dumps([*scenarios])


def read_scenarios(path: str | os.PathLike[str]) -> list[Scenario]:
    """Read what was flown in a video or a picture that quadrl has drawn.

    `quadrl.evaluate(policy, read_scenarios("flight.mp4")[0])` flies it again.

    Args:
        path: The file: .mp4, .gif, .png or .jpg.

    Returns:
        A scenario for each flight that it shows.

    Raises:
        RenderingUnavailable: There is no ffmpeg for a video, or no Pillow for a picture.
        QuadrlError: The file cannot be read, or carries no scenario that is known here.
    """
    path = Path(path)
    try:
        text = _of_video(path) if path.suffix.lower() == ".mp4" else _of_picture(path)
        listed = json.loads(text)
        check_texts(listed)
        if not listed or not all(isinstance(one, dict) and "task" in one for one in listed):
            raise ValueError("its comment holds none")
    except RenderingUnavailable:
        raise
    except (OSError, ValueError, TypeError, RecursionError) as error:
        reason = "give a file that quadrl render, plot or train has drawn"
        raise QuadrlError(f"{path} carries no scenario ({error}): {reason}") from error
    scenarios = [Scenario.of(one) for one in listed]
    for one, scenario in zip(listed, scenarios, strict=True):
        warn_of_changes(one, scenario, "file")
    return scenarios


def ffmpeg() -> str:
    """Path of an ffmpeg: the system's, else the one that imageio-ffmpeg brings."""
    own = shutil.which("ffmpeg")
    return own or require("imageio_ffmpeg").get_ffmpeg_exe()


def put_into_gif(path: Path, text: str) -> None:
    """Put a comment into a GIF, before its pictures."""
    content, coded = path.read_bytes(), text.encode()
    flags = content[10]
    colours = 3 << (flags & 7) + 1 if flags & 128 else 0  # bytes of the table of colours
    parts = (coded[k : k + LONGEST_BLOCK] for k in range(0, len(coded), LONGEST_BLOCK))
    blocks = b"".join(bytes([len(part)]) + part for part in parts)
    head = 13 + colours
    path.write_bytes(content[:head] + b"\x21\xfe" + blocks + b"\0" + content[head:])


def _of_video(path: Path) -> str:
    path.stat()  # a file that is not there is named so
    command = [ffmpeg(), "-v", "error", "-i", str(path), "-f", "ffmetadata", "-"]
    done = subprocess.run(command, capture_output=True, text=True)
    found = re.search(rf"^{COMMENT}=(.*)$", done.stdout, re.MULTILINE)
    if found is None:
        raise ValueError("it has no comment, or is no video")
    return re.sub(r"\\(.)", r"\1", found[1])


def _of_picture(path: Path) -> str:
    with require("PIL.Image").open(path) as picture:
        return picture.info.get(COMMENT, "")
