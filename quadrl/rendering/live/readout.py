"""The numbers beside the picture: a table and a bar for each rotor, as HTML."""

from __future__ import annotations

import numpy as np

from quadrl.base.units import length
from quadrl.engines.mjcf import rotor_colour
from quadrl.rendering.live.flight import Flight

LINE = '<div style="display:flex;justify-content:space-between;line-height:1.5">{}</div>'
CELL = (
    '<span style="opacity:.65">{}</span><span style="font-variant-numeric:tabular-nums">{}</span>'
)
BAR = (
    '<div style="flex:1;text-align:center"><div style="position:relative;height:64px;'
    'border-radius:4px;overflow:hidden;background:rgba(128,140,155,.22)">'
    '<div style="position:absolute;bottom:0;width:100%;height:{speed:.1f}%;background:{colour}">'
    '</div><div style="position:absolute;bottom:calc({command:.1f}% - 1px);width:100%;height:2px;'
    'background:currentColor"></div></div><span style="opacity:.65">{name}</span></div>'
)


def html(flight: Flight, row: int) -> str:
    """The state of one aircraft, and how the episodes of all have ended."""
    engine = flight.environment.engine
    position, velocity = flight.pose[row, :3], engine.qvel[row, :3]
    lines = {
        "time": f"{flight.time[row]:.2f} s",
        "speed": f"{np.linalg.norm(velocity):.2f} m/s",
        "height": f"{position[2]:.2f} m",
        "error": length(flight.error[row]),
        "reward of the step": f"{flight.reward[row]:+.2f}",
        "return": f"{flight.total[row]:.0f}",
        "episodes": f"{flight.episodes}, {flight.successes} successful",
    }
    if events := flight.environment.happening(row):
        lines["events"] = events
    table = "".join(LINE.format(CELL.format(*pair)) for pair in lines.items())
    bars = []
    for k, rotor in enumerate(flight.vehicle.rotors):
        red, green, blue = (round(255 * part) for part in rotor_colour(rotor.position))
        shares = (100 * np.clip(values[row, k] / rotor.max_speed, 0, 1)
                  for values in (engine.act, engine.ctrl))  # fmt: skip
        speed, command = shares
        colour = f"rgb({red},{green},{blue})"
        bars.append(BAR.format(speed=speed, command=command, colour=colour, name=k + 1))
    return (
        f'<div style="padding:4px 14px 8px;font-size:13px">{table}'
        '<div style="opacity:.65;margin-top:6px">rotor speeds, and a line at the command</div>'
        f'<div style="display:flex;gap:8px">{"".join(bars)}</div></div>'
    )
