"""Puts compiled libraries into the wheel; `scripts/wheels` runs it.

Without `$QUADRL_LIBRARIES`, a folder that is named as the platform, the wheel is for all of them.
"""

from __future__ import annotations

import os
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

INSIDE = "quadrl/engines/native/prebuilt"  # PREBUILT of compiling.py there


class Libraries(BuildHookInterface):
    """The hook of a wheel."""

    def initialize(self, version: str, build_data: dict) -> None:
        """Name the platform and what goes in; they run with every Python."""
        if chosen := os.environ.get("QUADRL_LIBRARIES"):
            folder = Path(chosen)
            build_data |= {"pure_python": False, "tag": f"py3-none-{folder.name}"}
            build_data["force_include"] |= {
                str(path): f"{INSIDE}/{path.name}" for path in sorted(folder.glob("*.so"))
            }
