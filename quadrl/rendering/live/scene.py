"""The picture in the browser: the nodes of viser's scene, and what is sent to move them."""

from __future__ import annotations

import collections
import contextlib
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.rendering import drawing
from quadrl.rendering.live import meshes
from quadrl.rendering.live.flight import Flight

CAMERAS = ("free", "follow", "chase")
# Where the camera stands, seen from where it looks, in sizes of what it shows.
VIEWS = {"free": (-0.7, -1.0, 0.5), "follow": (-1.2, -1.7, 0.9), "chase": (-2.2, 0.0, 0.7)}
FARTHEST = 2.0  # [m], of those sizes, for a goal far away
ROOM = 0.8  # in sizes, to either side of where "follow" looks, before the panel begins
LAG = 0.15  # [s], of the camera behind the aircraft
SEGMENTS = 3000  # of all trails together
PIECE = 0.1  # [s], of a trail
SKY = np.array([(78, 128, 196), (232, 240, 247), (214, 222, 229)])  # above, horizon, below
GROUND, METRES, TENS = (0.30, 0.37, 0.44), (0.43, 0.51, 0.58), (0.58, 0.66, 0.72)
FOV = math.radians(42)
UPRIGHT = np.array([(1.0, 0.0, 0.0, 0.0)])


@contextlib.contextmanager
def departures_ignored() -> Iterator[None]:
    """Silence the warning about a browser that leaves while something is sent to it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        yield


class Scene:
    """Draws a flight for every browser that looks."""

    def __init__(self, server: viser.ViserServer, flight: Flight) -> None:
        """Send what there is to see."""
        self._server, self._flight, self._scene = server, flight, server.scene
        count = flight.environment.num_envs
        self._columns = math.ceil(math.sqrt(count))
        self._home = flight.environment.origin  # where cameras look
        self._centre, self._heading = self._home.copy(), np.array([1.0, 0.0])
        self._shown: Any = None
        self._room = 0.0  # [m], see ROOM
        self._room = 0.0  # [m]
        self._labels, self._labelled = [], []
        model = flight.scenario.compile_model()
        seen = meshes.of_model(model)
        self._add_world(seen.world, count)
        self._airframe = self._add_copies("airframe", seen.solid, count)
        places = np.zeros((count, 3)), np.repeat(UPRIGHT, count, axis=0)
        self._clear = [
            self._scene.add_batched_meshes_simple(
                f"/world/clear_{k}", mesh.vertices, mesh.faces, *places[::-1],
                batched_colors=_bytes(rgba[:3]), opacity=rgba[3], cast_shadow=False,
            )
            for k, (mesh, rgba) in enumerate(seen.clear)
        ]  # fmt: skip
        self._rotors = [
            (self._add_copies(f"rotor_{k + 1}", blades, count), *hub)
            for k, (blades, hub) in enumerate(zip(seen.blades, seen.hubs, strict=True))
        ]

    def view(self, row: int, camera: str, apart: float) -> None:
        """Place the cameras of all browsers, also of those that connect later."""
        size = max(0.7 * self._flight.vehicle.scale, 0.05)
        if camera == "free":
            size = 2.5 + 0.95 * apart * (self._columns - 1)
        elif camera == "follow":
            away = float(np.linalg.norm(self._to_goal(row)))
            size = max(size, min(away / 2 / ROOM, FARTHEST))
        stand, self._room = self._home + size * np.array(VIEWS[camera]), ROOM * size
        cameras = [client.camera for client in self._server.get_clients().values()]
        for one in (self._server.initial_camera, *cameras):
            # A browser may have sent an impossible one.
            with departures_ignored(), contextlib.suppress(ValueError):
                one.position, one.look_at, one.fov = stand, self._home, FOV

    def draw(self, seconds: float, row: int, camera: str, apart: float) -> None:
        """Send the poses of this moment; the camera belongs to the aircraft of a row."""
        pose, offsets = self._flight.drawn(), self.offsets(apart)
        places = pose[:, :3] + offsets
        attitude = Rotation.from_quat(pose[:, 3:7], scalar_first=True)
        for node in (self._airframe, *self._clear):
            node.batched_positions, node.batched_wxyzs = places, pose[:, 3:7]
        for (node, hub, frame), angle in zip(self._rotors, pose[:, 7:].T, strict=True):
            turned = attitude * frame * Rotation.from_rotvec(angle[:, None] * (0, 0, 1))
            node.batched_positions = places + attitude.apply(hub)
            node.batched_wxyzs = turned.as_quat(scalar_first=True)
        if self._obstacles is not None:
            self._obstacles.batched_positions = offsets
        place = places[row]
        if camera == "follow":  # between the aircraft and its goal
            way = self._to_goal(row)
            place = place + way * min(0.5, self._room / max(float(np.linalg.norm(way)), 1e-9))
        self._move_world(seconds, camera, place, attitude[row].apply((1, 0, 0))[:2])

    def draw_paths(self, apart: float, markers: bool, trails: bool) -> None:
        """Send goals, markers and trails."""
        flight, offsets = self._flight, self.offsets(apart)
        shown: dict[str, list[Primitive]] = collections.defaultdict(list)
        for row, offset in enumerate(offsets if markers else ()):
            for one in drawing.markers(each.moved(offset) for each in flight.markers(row)):
                flat = one.shape in ("line", "label")
                shown[one.shape if flat else meshes.unit_name(one)].append(one)
        self._send_lines(shown.pop("line", []))
        self._send_labels(shown.pop("label", []))
        for name in {*shown, *self._batches}:
            self._send_batch(name, shown[name])
        self._trails.visible = trails
        trail = flight.trail[::-1][:: self._every][::-1]
        # Always as many segments: viser's client draws no more of them than it was sent first.
        trail = np.where(np.isfinite(trail), trail, flight.pose[:, :3]) + offsets
        colours = drawing.trail_colours(len(trail))[:, None, :3]
        self._trails.points = _segments(trail).astype(np.float32)
        self._trails.colors = _bytes(_segments(np.broadcast_to(colours, trail.shape)))

    def offsets(self, apart: float) -> Array:
        """Offsets (N, 3) [m] that put the worlds of the aircraft on a square grid."""
        numbers = np.arange(self._flight.environment.num_envs)
        across, along = numbers % self._columns, numbers // self._columns
        grid = np.stack([across, -along, 0 * numbers], axis=1).astype(float)
        return apart * (grid - (grid.min(0) + grid.max(0)) / 2)

    def _to_goal(self, row: int) -> Array:
        """The way (3,) [m] from an aircraft to its goal."""
        return self._flight.environment.goals()[row] - self._flight.pose[row, :3]

    def _move_world(self, seconds: float, camera: str, place: Array, ahead: Array) -> None:
        """Follow an aircraft by moving the world: the camera is left to the browser's user."""
        share = 1 - math.exp(-seconds / LAG)
        if camera == "free":
            place = self._home
        if self._shown != camera:
            share = 1.0
        self._shown = camera
        self._centre += share * (place - self._centre)
        self._heading += share * (ahead - self._heading)
        angle = -math.atan2(*self._heading[::-1]) if camera == "chase" else 0.0
        turn = Rotation.from_rotvec((0, 0, angle))
        self._world.wxyz = turn.as_quat(scalar_first=True)
        self._world.position = self._home - turn.apply(self._centre)

    def _add_world(self, obstacles: bytes | None, count: int) -> None:
        scene = self._scene
        ramp = np.interp(np.arange(512), (0, 300, 511), (0, 1, 2))
        sky = np.stack([np.interp(ramp, (0, 1, 2), part) for part in SKY.T], axis=1)
        scene.set_background_image(np.tile(sky[:, None].astype(np.uint8), (1, 2, 1)), "png")
        scene.configure_default_lights(False)
        scene.configure_fog(30.0, 140.0, color=tuple(SKY[1]))
        self._world = scene.add_frame("/world", show_axes=False)
        scene.add_light_hemisphere(
            "/world/light", sky_color=(235, 242, 255), ground_color=(140, 140, 135), intensity=1.1
        )
        scene.add_light_directional(
            "/world/sun", color=(255, 247, 232), intensity=1.6, position=(-4.0, -2.0, 8.0),
            cast_shadow=True,
        )  # fmt: skip
        scene.add_grid(
            "/world/ground", 200, 200, cell_size=1.0, section_size=10.0, cell_color=_bytes(METRES),
            section_color=_bytes(TENS), section_thickness=1.5, infinite_grid=True,
            fade_distance=120.0, shadow_opacity=0.45, plane_color=_bytes(GROUND), plane_opacity=1.0,
        )  # fmt: skip
        self._obstacles = None
        if obstacles is not None:
            self._obstacles = self._add_copies("obstacles", obstacles, count)
        steps, timestep = len(self._flight.trail), self._flight.vehicle.control_timestep
        # Nothing is seen of a line of short pieces: each shorter than a pixel is left out.
        self._every = max(math.ceil(PIECE / timestep), math.ceil(count * steps / SEGMENTS))
        self._trails = self._add_lines("trails", (math.ceil(steps / self._every) - 1) * count, 3.0)
        self._marks = self._add_lines("marks", 0, 2.0)
        self._batches: dict[str, Any] = {}

    def _add_lines(self, name: str, count: int, pixels: float) -> viser.LineSegmentsHandle:
        none = np.zeros((count, 2, 3), dtype=np.float32)
        return self._scene.add_line_segments(
            f"/world/{name}", none, none, thickness=pixels, thickness_units="screen"
        )

    def _add_copies(self, name: str, glb: bytes, count: int) -> viser.BatchedGlbHandle:
        attitudes, places = np.repeat(UPRIGHT, count, axis=0), np.zeros((count, 3))
        return self._scene.add_batched_glb(f"/world/{name}", glb, attitudes, places)

    def _send_lines(self, lines: Sequence[Primitive]) -> None:
        points, colours = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3))]
        for line in lines:
            corners = np.asarray(line.points, dtype=float)
            rgba = np.broadcast_to(line.rgba, (len(corners), 4))[:-1, None, :3]
            points.append(_segments(corners))
            colours.append(np.repeat(rgba, 2, axis=1))
        sent = np.concatenate(points).astype(np.float32)
        if len(self._marks.points) != len(sent):
            self._marks = self._add_lines("marks", len(sent), 2.0)
        self._marks.points, self._marks.colors = sent, _bytes(np.concatenate(colours))

    def _send_batch(self, name: str, batch: Sequence[Primitive]) -> None:
        """Show copies of one mesh, as many as there are primitives."""
        node = self._batches.pop(name, None)
        if node is not None and len(node.batched_positions) != len(batch):
            node.remove()
            node = None
        if not batch:
            return
        placed = map(meshes.placed, batch)
        places, attitudes, scales = (np.array(part) for part in zip(*placed, strict=True))
        rgba = np.array([one.rgba for one in batch], dtype=float)
        if node is None:
            mesh, lit = meshes.unit(batch[0]), batch[0].glow < 1.0
            node = self._scene.add_batched_meshes_simple(
                f"/world/{name}", mesh.vertices, mesh.faces, attitudes, places,
                batched_scales=scales, batched_colors=_bytes(rgba[:, :3]),
                batched_opacities=rgba[:, 3], opacity=1.0, cast_shadow=lit, receive_shadow=lit,
            )  # fmt: skip
        self._batches[name] = node
        node.batched_positions, node.batched_wxyzs, node.batched_scales = places, attitudes, scales
        node.batched_opacities, node.batched_colors = rgba[:, 3], _bytes(rgba[:, :3])

    def _send_labels(self, labels: Sequence[Primitive]) -> None:
        shown = [
            (one.name, tuple(np.add(one.position, (0.0, 0.0, 1.5 * float(np.max(one.size))))))
            for one in labels
        ]
        if shown == self._labelled:
            return
        for node in self._labels:
            node.remove()
        self._labelled = shown
        self._labels = [
            self._scene.add_label(f"/world/label_{k}", text, position=place)
            for k, (text, place) in enumerate(shown)
        ]


def _segments(points: Array) -> Array:
    """Both ends (n, 2, 3) of the pieces of paths (T, 3) or (T, N, 3)."""
    return np.stack([points[:-1], points[1:]], axis=-2).reshape(-1, 2, 3)


def _bytes(colours: Any) -> Array:
    """Convert colours of the screen, 0 to 1, to bytes of linear light, as the browser expects."""
    return np.round(255 * np.asarray(colours, dtype=float) ** 2.2).astype(np.uint8)
