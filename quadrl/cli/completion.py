"""`quadrl completion`."""

from __future__ import annotations

import dataclasses
from typing import Literal

from tyro.conf import Positional


@dataclasses.dataclass(frozen=True)
class Completion:
    """Print a script that completes commands, options and names with the tab key.

    bash: source <(quadrl completion bash). zsh: write it to a file _quadrl in a folder of fpath.
    """

    shell: Positional[Literal["bash", "zsh", "tcsh", "fish"]] = "bash"
    """The shell to complete in."""

    def run(self) -> None:
        """Print the script."""
        from quadrl.cli import parse

        parse(["--tyro-print-completion", self.shell], enforced=True)
