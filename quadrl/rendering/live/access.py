"""Access control of the page: only a browser that shows it may steer, and only with its controls.

Any web page may connect to a port of this machine. Its browser says in the header Origin where the
page came from, and in Host by which name it reached the port. A stranger's domain that was made to
point to this machine (DNS rebinding) is recognized by its name.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import socket
import urllib.parse
from typing import Annotated, Any, cast

import msgspec
import viser
from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.http11 import Request

from quadrl.base.errors import QuadrlError

LARGEST_MESSAGE = 1 << 14  # [bytes] of a client; the largest tells its camera
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Vector = tuple[Number, Number, Number]
# viser takes long strings of digits for integers too large to send on, and loses every client.
Text = Annotated[str, msgspec.Meta(pattern=r"^.{0,18}$|[^\d\s_+-]")]


class Update(msgspec.Struct):
    """What a client may change of a control: nothing but its value."""

    value: bool | Number | Text


# The messages of viser that the page needs, by their names. Others let a client open a tunnel to
# the internet, upload files, or fill the memory.
class GuiUpdateMessage(msgspec.Struct, tag=True):
    """The message that a control was moved, with its new value."""

    uuid: str
    updates: Update


class CommandTriggerMessage(msgspec.Struct, tag=True):
    """The message that a key was pressed."""

    uuid: str


class ViewerCameraMessage(msgspec.Struct, tag=True):
    """The message that a camera was moved; with the first one a client counts as connected."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    look_at: Vector
    up_direction: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number


_DECODER = msgspec.msgpack.Decoder(GuiUpdateMessage | CommandTriggerMessage | ViewerCameraMessage)


class Connection(server.ServerConnection):
    """A client's connection, of which only the messages above arrive."""

    async def recv(self, decode: bool | None = None) -> Any:
        """Receive the next message that the page needs, reduced to the fields that it needs."""
        while True:
            message = await super().recv(decode=False)
            with contextlib.suppress(msgspec.MsgspecError):
                return msgspec.msgpack.encode(_DECODER.decode(message))


def refusal(headers: Headers, host: str) -> str | None:
    """Say why a request is refused: it does not come from the page itself.

    Args:
        headers: Headers of the request.
        host: Address that the page is served at.

    Returns:
        The reason in a line, or None where it does come from the page.
    """
    reached, origins = headers.get_all("Host"), headers.get_all("Origin")
    names = ["localhost", socket.gethostname().lower(), host.lower()]
    if len(reached) != 1 or not _names_this_machine(reached[0], names):
        known = ", ".join(dict.fromkeys(names))
        return f"Host is {reached}: must be an IP address or one of {known} (--host NAME)"
    if "Upgrade" not in headers and not origins:  # asks for the page
        return None
    own = [f"{scheme}://{reached[0].lower()}" for scheme in ("http", "https")]
    if len(origins) != 1 or origins[0].lower() not in own:
        return f"Origin is {origins}: must be this page's own, {own[0]}"
    return None


def serve(host: str, port: int) -> viser.ViserServer:
    """Start viser's server so that it answers to its own page alone.

    viser has no option for that, so the server of websockets that it starts is replaced by one that
    checks.

    Raises:
        QuadrlError: viser did not use that server; it is stopped then.
    """
    unchecked, guarded = server.serve, []

    def checked(handler: Any, *where: Any, process_request: Any = None, **options: Any) -> Any:
        guarded.append(handler)
        options |= {"max_size": LARGEST_MESSAGE, "create_connection": Connection}

        def check(connection: server.ServerConnection, request: Request) -> Any:
            if reason := refusal(request.headers, host):
                return connection.respond(403, f"{reason}\n")
            return process_request(connection, request) if process_request else None

        return unchecked(handler, *where, process_request=check, **options)

    with contextlib.redirect_stdout(io.StringIO()):  # viser announces itself
        try:
            cast(Any, server).serve = checked
            started = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            cast(Any, server).serve = unchecked
        if not guarded:
            started.stop()
            raise QuadrlError(
                f"viser {viser.__version__} cannot be kept from answering to any web page: "
                "install an earlier one"
            )
    return started


def _names_this_machine(reached: str, names: list[str]) -> bool:
    """Whether a header Host is an IP address or one of some names, with or without a port."""
    try:
        name = urllib.parse.urlsplit(f"//{reached}").hostname or ""
        return name in names or bool(ipaddress.ip_address(name))
    except ValueError:
        return False
