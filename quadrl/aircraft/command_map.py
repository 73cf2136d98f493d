"""What a motor command means: the rotor speed that it brings."""

from __future__ import annotations

import dataclasses

from quadrl.aircraft.rotors import MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import number


@dataclasses.dataclass(frozen=True)
class CommandMap:
    """The rotor speed that a motor command u, 0 to 1 (PWM over 65535), brings in the end [rad/s].

    It is offset + (gain + gain_by_volt V) u, with the battery's voltage V.
    """

    offset: float
    """[rad/s]: where the line over u begins; a rotor that stands still needs no command."""
    gain: float = 0.0
    """[rad/s]"""
    gain_by_volt: float = 0.0
    """[rad/(s V)]; 0 where the battery was not logged, or is compensated on board."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name in ("offset", "gain"):
            object.__setattr__(self, name, number(name, getattr(self, name), -MAX, MAX))
        volts = number("gain_by_volt", self.gain_by_volt, 0, MAX)
        object.__setattr__(self, "gain_by_volt", volts)
        if self.gain <= 0 and not self.gain_by_volt:
            allowed = "above 0: a rotor turns faster with a larger command"
            raise QuadrlError(name="gain", value=self.gain, allowed=allowed)

    def __str__(self) -> str:
        parts = (f"{self.gain:.0f} u", f"{self.gain_by_volt:.0f} V u")
        used = (part for part in parts if not part.startswith("0 "))
        return f"{' + '.join([f'{self.offset:.0f}', *used])} rad/s, u from 0 to 1"

    def speed(self, command: Array, battery: Array | float = 0.0) -> Array:
        """Rotor speeds (..., R) [rad/s] of commands (..., R), 0 to 1, at a battery (..., 1) [V]."""
        return self.offset + (self.gain + self.gain_by_volt * battery) * command

    def command(self, speed: Array, battery: Array | float = 0.0) -> Array:
        """Commands (..., R) that bring rotor speeds [rad/s]; beyond [0, 1] where none can."""
        return (speed - self.offset) / (self.gain + self.gain_by_volt * battery)
