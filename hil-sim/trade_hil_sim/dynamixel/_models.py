"""The models of the X series, and MX with the firmware for protocol 2.0: their differences.

Source: ROBOTIS e-Manual, the page of each model. Where no no-load speed was found (XW430, XW540-H260), it is that
of the velocity limit; XD430-T350 and XD540-T270 have the figures of the XH, whose control table they share.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ._table import Access, Indirect, Model, Register, gain, x_series

WRITE: Final = Access.WRITE
SIX_MODES: Final = frozenset({0, 1, 3, 4, 5, 16})
WITHOUT_CURRENT: Final = frozenset({1, 3, 4, 16})
MOST_SPEED: Final = 1023


@dataclass(frozen=True, slots=True)
class _Family:
    """Data common to models of one size and supply."""

    supply_v: float
    volts: tuple[int, int]
    """Its limits as shipped, in 0.1 V."""
    temperature: int = 80
    lowest: int | None = None
    """The lowest value for the voltage limits, where it differs from the default."""
    firmware: int = 45
    bauds: int = 7
    """The highest value of its baud rate register."""
    most_speed: int = MOST_SPEED
    shutdown: int = 52
    led: bool = True
    ports: bool = False
    """It has external ports."""
    acceleration_limit: bool = False
    pwm_slope: int | None = None
    indirect: tuple[Indirect, ...] = (Indirect(1, 28, 168, 224), Indirect(29, 28, 578, 634))

    def registers(self) -> list[Register]:
        low, high = self.volts
        lowest = low if self.lowest is None else self.lowest
        found = [
            Register(8, 1, "baud_rate", WRITE, 1, 0, self.bauds),
            Register(31, 1, "temperature_limit", WRITE, self.temperature, 0, 100),
            Register(32, 2, "max_voltage_limit", WRITE, high, lowest, high),
            Register(34, 2, "min_voltage_limit", WRITE, low, lowest, high),
            Register(63, 1, "shutdown", WRITE, self.shutdown, 0, 63),
        ]
        if self.led:
            found.append(Register(65, 1, "led", WRITE, 0, 0, 1))
        if self.acceleration_limit:
            found.append(Register(40, 4, "acceleration_limit", WRITE, 32_767, 0, 32_767))
        if self.pwm_slope is not None:
            found.append(Register(62, 1, "pwm_slope", WRITE, self.pwm_slope, 1, 255))
        if self.ports:
            found += [Register(56 + k, 1, f"external_port_mode_{k + 1}", WRITE, 3, 0, 3) for k in range(3)]
            found += [Register(152 + 2 * k, 2, f"external_port_data_{k + 1}", WRITE, 0, 0, 65_535) for k in range(3)]
        return found


_X330_INDIRECT: Final = (Indirect(1, 20, 168, 208),)
"""From the manual and the vendor's table for firmware 52; the table for older firmware begins at 224."""
_XL430: Final = _Family(12.0, (60, 140), 72)
_XC430: Final = _Family(12.0, (60, 160))
_X430: Final = _Family(12.0, (95, 160))
_X430_24V: Final = _Family(24.0, (110, 300))
_X540: Final = _Family(12.0, (95, 160), ports=True)
_X540_24V: Final = _Family(24.0, (110, 300), ports=True)
_XW: Final = _Family(12.0, (95, 160), led=False)
_MX: Final = _Family(12.0, (95, 160), acceleration_limit=True)
_XW_24V: Final = _Family(24.0, (110, 300), led=False)


def _x330(supply_v: float, volts: tuple[int, int], lowest: int, slope: int, shutdown: int = 52) -> _Family:
    return _Family(
        supply_v,
        volts,
        70,
        lowest,
        firmware=52,
        bauds=6,
        most_speed=2047,
        shutdown=shutdown,
        pwm_slope=slope,
        indirect=_X330_INDIRECT,
    )


_XL330: Final = _x330(5.0, (35, 70), 31, 140, shutdown=53)
_XC330_M: Final = _x330(5.0, (35, 70), 31, 140)
_XC330_T: Final = _x330(12.0, (55, 140), 55, 255)

_Gains = tuple[int, int, int, int, int]
"""Velocity I and P, position D, I and P."""


def _model(
    number: int,
    name: str,
    family: _Family,
    velocity_limit: int,
    no_load_rpm: float,
    current_limit: int | None = None,
    gains: _Gains = (1920, 100, 0, 0, 800),
) -> Model:
    own = [
        *family.registers(),
        Register(44, 4, "velocity_limit", WRITE, velocity_limit, 0, family.most_speed),
        *(
            gain(76 + 2 * k, f"{what}_gain", default)
            for k, (what, default) in enumerate(
                zip(("velocity_i", "velocity_p", "position_d", "position_i", "position_p"), gains, strict=True)
            )
        ),
    ]
    if current_limit is None:
        own.append(Register(126, 2, "present_load", Access.READ, signed=True))
    else:
        own += [
            Register(38, 2, "current_limit", WRITE, current_limit, 0, current_limit),
            Register(102, 2, "goal_current", WRITE, current_limit, signed=True),
            Register(126, 2, "present_current", Access.READ, signed=True),
        ]
    return Model(
        name=name,
        number=number,
        firmware=family.firmware,
        registers=x_series(number, family.firmware, own, family.indirect),
        modes=WITHOUT_CURRENT if current_limit is None else SIX_MODES,
        no_load_rpm=no_load_rpm,
        supply_v=family.supply_v,
        indirect=family.indirect,
    )


_MX_GAINS: Final = (1920, 100, 0, 0, 850)
_XH430_GAINS: Final = (1920, 100, 0, 0, 900)
_ALL: Final = (
    _model(1060, "XL430-W250", _XL430, 265, 61, gains=(1000, 100, 4000, 0, 640)),
    _model(1090, "2XL430-W250", _XL430, 250, 61, gains=(1800, 100, 2000, 0, 640)),
    _model(1070, "XC430-W150", _XC430, 460, 106, gains=(1920, 100, 0, 0, 460)),
    _model(1080, "XC430-W240", _XC430, 306, 70, gains=(1920, 100, 0, 0, 700)),
    _model(1160, "2XC430-W250", _XC430, 275, 64, gains=(1920, 100, 0, 0, 700)),
    _model(1190, "XL330-M077", _XL330, 1620, 383, 1750, (400, 40, 0, 400, 400)),
    _model(1200, "XL330-M288", _XL330, 445, 103, 1750, (1600, 180, 0, 0, 400)),
    _model(1230, "XC330-M181", _XC330_M, 545, 129, 2352, (1400, 100, 500, 0, 1200)),
    _model(1240, "XC330-M288", _XC330_M, 350, 81, 2352, (1600, 50, 500, 0, 1100)),
    _model(1210, "XC330-T181", _XC330_T, 510, 113, 910, (1200, 40, 0, 0, 900)),
    _model(1220, "XC330-T288", _XC330_T, 320, 71, 910, (1200, 40, 0, 0, 900)),
    _model(1020, "XM430-W350", _X430, 200, 46, 1193),
    _model(1030, "XM430-W210", _X430, 330, 77, 1193),
    _model(1000, "XH430-W350", _X430, 130, 30, 648, _XH430_GAINS),
    _model(1010, "XH430-W210", _X430, 210, 50, 648, _XH430_GAINS),
    _model(1001, "XD430-T350", _X430, 130, 30, 648, _XH430_GAINS),
    _model(1011, "XD430-T210", _X430, 210, 50, 648, _XH430_GAINS),
    _model(1040, "XH430-V350", _X430_24V, 135, 31, 689),
    _model(1050, "XH430-V210", _X430_24V, 230, 52, 689),
    _model(1120, "XM540-W270", _X540, 128, 30, 2047),
    _model(1130, "XM540-W150", _X540, 230, 53, 2047),
    _model(1100, "XH540-W270", _X540, 167, 39, 2047),
    _model(1110, "XH540-W150", _X540, 300, 70, 2047),
    _model(1101, "XD540-T270", _X540, 167, 39, 2047),
    _model(1111, "XD540-T150", _X540, 300, 70, 2047),
    _model(1140, "XH540-V270", _X540_24V, 128, 34, 1188),
    _model(1150, "XH540-V150", _X540_24V, 230, 60, 1188),
    _model(1270, "XW430-T333", _XW, 139, 31.8, 2047, _XH430_GAINS),
    _model(1280, "XW430-T200", _XW, 235, 53.8, 2047, _XH430_GAINS),
    _model(1170, "XW540-T260", _XW, 167, 40, 2047),
    _model(1180, "XW540-T140", _XW, 304, 72, 2047),
    _model(1310, "XW540-H260", _XW_24V, 145, 33.2, 1188),
    _model(30, "MX-28", _MX, 380, 55, gains=_MX_GAINS),
    _model(311, "MX-64", _MX, 435, 63, 1941, _MX_GAINS),
    _model(321, "MX-106", _MX, 360, 45, 2047, _MX_GAINS),
)
MODELS: Final[Mapping[str, Model]] = {model.name: model for model in _ALL}
"""Simulated models, by the name printed on the device."""
XL430_W250: Final = MODELS["XL430-W250"]
XM430_W350: Final = MODELS["XM430-W350"]
