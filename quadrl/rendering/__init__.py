"""Pictures and videos of flights, drawn off screen with MuJoCo.

Everything is in the world frame (East-North-Up, metres). Drawing calls only MuJoCo's kinematics,
never its dynamics: it needs no rotor callbacks and leaves the simulation's own data alone.
"""

from quadrl.base.errors import RenderingUnavailable
from quadrl.core.trajectory import Trajectory
from quadrl.rendering.scenarios import read_scenarios
from quadrl.rendering.scene import Renderer
from quadrl.rendering.sheet import write_contact_sheet
from quadrl.rendering.video import help_notebooks, render_trajectory, write_video

__all__ = [
    "Renderer",
    "RenderingUnavailable",
    "Trajectory",
    "read_scenarios",
    "render_trajectory",
    "write_contact_sheet",
    "write_video",
]

help_notebooks()
