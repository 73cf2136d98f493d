"""The page: a flight drawn in the browser with viser, and the controls beside it.

The flight belongs to one thread, which calls `Page.frame`. It reads sliders and boxes, and does
what buttons and keys have put into a queue. viser's own threads talk to browsers.
"""

from __future__ import annotations

import contextlib
import io
import queue
import socket
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any, cast

import numpy as np
import viser

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number
from quadrl.evaluation.in_flight import Controller
from quadrl.rendering.live import access, readout
from quadrl.rendering.live.flight import KEYS, Flight, Keyboard
from quadrl.rendering.live.scene import CAMERAS, Scene, departures_ignored

FRAME = 1 / 30  # [s]
READOUT = 0.1  # [s] between two updates of the numbers
HISTORY = 200  # updates in the plot
PUSHES = {"west": (-1, 0, 0), "east": (1, 0, 0), "south": (0, -1, 0), "north": (0, 1, 0),
          "down": (0, 0, -1), "up": (0, 0, 1)}  # fmt: skip
KEYBOARD = "keyboard"
MOST_ASKED = 32  # actions that wait for the next frame; further ones are dropped


class Control:
    """An input of the page, read within its bounds: a client may have sent any value."""

    def __init__(self, handle: viser.GuiInputHandle[Any]) -> None:
        """Take the bounds of a slider, a dropdown or a checkbox."""
        self._handle, self._value = handle, handle.value
        self._range = (handle.min, handle.max) if isinstance(handle, viser.GuiSliderHandle) else ()
        self._choices = getattr(handle, "options", (False, True))

    @property
    def value(self) -> Any:
        """A number of a slider's range, or one of the choices; the last one where it is neither."""
        sent = self._handle.value
        if not self._range:
            self._value = sent if sent in self._choices else self._value
        elif isinstance(sent, (int, float)) and sent == sent:  # not NaN
            low, high = self._range
            self._value = type(self._value)(min(max(sent, low), high))
        if sent != self._value:
            self.value = self._value  # so that every browser shows what counts
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        with contextlib.suppress(TypeError, ValueError):  # viser holds another kind of value
            self._handle.value = value


class Page:
    """A server that shows a flight; close it at the end."""

    def __init__(
        self,
        flight: Flight,
        controllers: Mapping[str, Callable[[], Controller]],
        *,
        host: str = "localhost",
        port: int = 8080,
    ) -> None:
        """Open the server.

        Args:
            flight: What is shown.
            controllers: Functions that make the controllers to choose from, by name; the first is
                the one that flies now.
            host: Address to listen at.
            port: Port to listen at; 0 for any that is free.

        Raises:
            QuadrlError: Nothing can listen at that address, or any web page could steer the flight.
        """
        _check_address(host, port)
        self.flight, self.keyboard = flight, Keyboard()
        self.controllers = dict(controllers) | {KEYBOARD: lambda: self.keyboard}
        self._asked: queue.Queue[Callable[[], None]] = queue.Queue(MOST_ASKED)
        self.server = access.serve(host, port)
        here = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.address = f"http://{here}:{self.server.get_port()}"
        self._flown_by, self._viewed, self._plotted = next(iter(self.controllers)), None, None
        self._history, self._clock, self._last_readout = np.zeros((3, 0)), 0.0, 0.0
        self._add_controls()
        self.scene = Scene(self.server, flight)

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def run(self) -> None:
        """Fly and draw until interrupted."""
        last = time.perf_counter()
        while True:
            now = time.perf_counter()
            self.frame(now - last)
            last = now
            time.sleep(max(0.0, FRAME - (time.perf_counter() - now)))

    def frame(self, seconds: float) -> None:
        """Do what was asked for, fly for some seconds of the wall clock, and draw."""
        flight = self.flight
        for _ in range(self._asked.qsize()):
            self._asked.get_nowait()()
        flight.wind[:] = [slider.value for slider in self.wind]
        flight.speed, flight.paused = self.speed.value, self.paused.value
        flight.endless = self.endless.value
        self._change_controller()
        self._clock += flight.advance(seconds) * flight.vehicle.control_timestep
        camera, apart = self.camera.value, self.apart.value
        if self._viewed != (camera, apart):
            self._viewed = camera, apart
            self.scene.view(self.row, camera, apart)
        with self.server.atomic():
            self.scene.draw(seconds, self.row, camera, apart)
            self.scene.draw_paths(apart, self.show_markers.value, self.show_trails.value)
        if time.perf_counter() - self._last_readout > READOUT:
            self._last_readout = time.perf_counter()
            self._write()

    def _write(self) -> None:
        """Send the numbers and the plot of one aircraft."""
        flight, row = self.flight, self.row
        self.numbers.content = readout.html(flight, row)
        if self._plotted != row:
            self._plotted, self._history = row, np.zeros((3, 0))
        speed = np.linalg.norm(flight.environment.engine.qvel[row, :3])
        point = np.array([self._clock, flight.error[row], speed])
        if not flight.paused or not self._history.size:
            self._history = np.column_stack([self._history, point])[:, -HISTORY:]
            self.plot.data = tuple(self._history.copy())

    @property
    def row(self) -> int:
        """The aircraft that the camera and the numbers are of."""
        # A slider has two ends, even that of a single aircraft.
        return min(self.aircraft.value, self.flight.environment.num_envs) - 1

    def _change_controller(self) -> None:
        chosen = self.flown_by.value
        if chosen == self._flown_by:
            return
        try:
            self.keyboard.press("stop")
            self.flight.fly_with(self.controllers[chosen]())
            self._flown_by = chosen
        except QuadrlError as error:
            self.flown_by.value = self._flown_by
            with departures_ignored():
                for client in self.server.get_clients().values():
                    client.add_notification(f"{chosen} cannot fly this", str(error))

    def push(self, direction: str) -> None:
        """Push the aircraft that is looked at: one of PUSHES, as hard as the slider says."""
        self.flight.push(self.strength.value * np.array(PUSHES[direction], dtype=float), self.row)

    def _add_controls(self) -> None:
        gui, count = self.server.gui, self.flight.environment.num_envs
        gui.set_panel_label(f"quadrl: {self.flight.task.name}")
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(235, 96, 24))
        self.numbers = gui.add_html("")
        blue, orange = "rgb(60,110,190)", "rgb(235,96,24)"
        self.plot = gui.add_uplot(
            (np.zeros(2),) * 3,
            ({"label": "time [s]"}, {"label": "error [m]", "stroke": orange, "width": 2},
             {"label": "speed [m/s]", "stroke": blue, "width": 1.5}),
            scales={"x": {"time": False}},
            aspect=2.2,
        )  # fmt: skip
        with gui.add_folder("Flight"):
            self.flown_by = Control(gui.add_dropdown("flown by", tuple(self.controllers)))
            self.paused = Control(gui.add_checkbox("paused", False))
            self.speed = Control(gui.add_slider("speed of time", 0.1, 4.0, 0.1, 1.0))
            self.endless = Control(
                gui.add_checkbox(
                    "without end", False, hint="only flying into the ground ends an episode"
                )
            )
            self._add_buttons("", {"one step": self._step_once, "new episodes": self.flight.reset})
        with gui.add_folder("Wind [m/s]"):
            self.wind = [
                Control(gui.add_slider(to, -10.0, 10.0, 0.1, 0.0)) for to in ("east", "north", "up")
            ]
            gui.add_button("calm").on_click(self._asks(lambda event: self._calm))
        with gui.add_folder("Push"):
            self.strength = Control(gui.add_slider("by [m/s]", 0.1, 5.0, 0.1, 1.0))
            self._add_buttons("to", {to: partial(self.push, to) for to in PUSHES})
        with gui.add_folder("Picture"):
            many = count > 1
            first = "free" if many else "follow"
            self.camera = Control(gui.add_dropdown("camera", CAMERAS, initial_value=first))
            self.aircraft = Control(
                gui.add_slider("aircraft", 1, max(2, count), 1, 1, visible=many)
            )
            self.apart = Control(gui.add_slider("apart [m]", 0.0, 20.0, 0.5, 4.0, visible=many))
            self.show_markers = Control(gui.add_checkbox("goals and markers", True))
            self.show_trails = Control(gui.add_checkbox("trails", True))
        self._add_keys()

    def _asks(
        self, find: Callable[[Any], Callable[[], None] | None]
    ) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Make the callback of a click or a key: the action found for it waits for the next frame.

        It is a coroutine, since viser lets any number of plain functions wait for a thread.
        """

        async def ask(event: Any) -> None:
            action = find(event)
            if action is not None:
                with contextlib.suppress(queue.Full):
                    self._asked.put_nowait(action)

        return ask

    def _add_buttons(self, label: str, actions: Mapping[str, Callable[[], None]]) -> None:
        buttons = self.server.gui.add_button_group(label, tuple(actions))
        buttons.on_click(self._asks(lambda event: actions.get(event.target.value)))

    def _add_keys(self) -> None:
        gui = self.server.gui
        keys: dict[str, tuple[str, Callable[[], None]]] = {
            "space": ("pause, or go on", self._pause),
            "N": ("one step", self._step_once),
            "R": ("new episodes", self.flight.reset),
            "X": (f"{KEYBOARD}: stop", partial(self.keyboard.press, "X")),
        }
        for key, (_, _, meaning) in KEYS.items():
            keys[key] = f"{KEYBOARD}: {meaning}", partial(self.keyboard.press, key)
        for key, (meaning, change) in keys.items():
            command = gui.add_command(meaning, hotkey=cast(Any, key))
            command.on_trigger(self._asks(lambda event, change=change: change))
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown("\n".join(f"- `{key}` {what}" for key, (what, _) in keys.items()))

    def _calm(self) -> None:
        for slider in self.wind:
            slider.value = 0.0

    def _pause(self) -> None:
        self.paused.value = not self.paused.value

    def _step_once(self) -> None:
        self.paused.value = True
        self.flight.step_once()


def _check_address(host: str, port: int) -> None:
    """Refuse an address at which nothing can listen; viser would choose another one.

    Raises:
        QuadrlError: The port is taken or not allowed, or the host is none of this machine's.
    """
    number("port", port, 0, 65535, whole=True)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            # As asyncio binds: what a server before has left behind does not count.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(found[0][4])
    except OSError as error:
        reason = f"it cannot be opened ({error.strerror}); choose another --port or --host"
        raise QuadrlError(reason, name="address", value=f"{host}:{port}") from error
