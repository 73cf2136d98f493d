"""Libraries that extras of the package bring, and the line that says which one is missing."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Generator

from quadrl.base.errors import QuadrlError, RenderingUnavailable

_BROUGHT = {
    "'quadrl[train]'": "torch torchrl tensordict tensorboard",
    "'quadrl[video]'": "matplotlib PIL mediapy imageio_ffmpeg",
    "'quadrl[view]'": "viser trimesh msgspec websockets",
    "'quadrl[export]'": "onnx onnxruntime",
    "'quadrl[gpu]'": "cuda",
    "'quadrl[logs]'": "pyulog orangebox rosbags",
    "'quadrl[wandb]'": "wandb",
    "'quadrl[ray]'": "ray",
    "'quadrl[rsl_rl]'": "rsl_rl",
    "stable-baselines3": "stable_baselines3",
}
"""Modules, by what pip installs them with."""


class MissingLibrary(QuadrlError, ModuleNotFoundError):
    """A library of an extra is not installed; `name` is its module."""


@contextlib.contextmanager
def needed(by: str, *libraries: str) -> Generator[None]:
    """Say in a line which library of an extra is missing, where an import within it fails.

    Args:
        by: What needs it, as the caller knows it: `quadrl train`; the outermost one counts.
        libraries: Modules that are needed later, looked for now.

    Raises:
        MissingLibrary: The line says how to install it.
    """
    try:
        for name in libraries:
            if importlib.util.find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        yield
    except (ModuleNotFoundError, RenderingUnavailable) as error:
        absent = error if isinstance(error, ModuleNotFoundError) else error.__cause__
        library = (getattr(absent, "name", None) or "").partition(".")[0]
        for what, modules in _BROUGHT.items():
            if library in modules.split():
                line = f"{by} needs {library}: python -m pip install {what}"
                missing = MissingLibrary(line)
                missing.name, missing.allowed = library, "installed"
                raise missing from error
        raise
