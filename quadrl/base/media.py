"""Pictures and videos that show themselves in a notebook."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Callable
from pathlib import Path

from quadrl.base.errors import QuadrlError
from quadrl.base.files import in_a_folder, write_whole


@dataclasses.dataclass(frozen=True, repr=False)
class Media:
    """A picture or a video."""

    content: bytes
    """Content of the file."""
    kind: str
    """The file's ending: png, mp4, gif, pdf or svg."""
    make: Callable[[str], bytes] | None = dataclasses.field(default=None, compare=False)
    """Converts to the content of a file with another ending; None for videos."""

    def __repr__(self) -> str:
        return f"{self.kind}, {len(self.content) // 1024} kB; save(path) writes it"

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.content).decode()
        if self.kind == "mp4":
            return f'<video controls loop src="data:video/mp4;base64,{data}"></video>'
        if self.kind == "pdf":
            return f'<embed type="application/pdf" src="data:application/pdf;base64,{data}"/>'
        kind = "svg+xml" if self.kind == "svg" else self.kind
        return f'<img style="max-width:100%" src="data:image/{kind};base64,{data}"/>'

    def save(self, path: str | Path) -> Path:
        """Write the file, whole or not at all.

        Raises:
            QuadrlError: There is no such folder, or the name has an ending that is not the kind's,
                nor one of a figure.
        """
        path = in_a_folder(path)
        content, kind = self.content, path.suffix.lower().lstrip(".")
        if kind != self.kind:
            if self.make is None or not kind:
                allowed = f"a name that ends in .{self.kind}"
                raise QuadrlError(name="path", value=str(path), allowed=allowed)
            content = self.make(kind)
        write_whole(path, content)
        return path
