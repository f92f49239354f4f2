"""What can go wrong with a device and its bus, and what is to come of it: the tests judge by this table.

``python -m tests.unit.drivers.fault_table > docs/faults.md`` writes the page.
"""

from collections.abc import Iterator
from typing import Final

import msgspec

from trade.errors import BusGone, DeviceError, DeviceFault, DeviceSilent, MotionStopped
from trade_hil_sim import (
    Absent,
    BadCrc,
    BrownOut,
    BusOff,
    Emergency,
    Freeze,
    Garbage,
    HangUp,
    HardwareFault,
    Heal,
    Jam,
    Late,
    Local,
    Mute,
    Replug,
    Supply,
    Truncate,
    Unplug,
    WrongModel,
)

from .fault_row import STRUCK, Dashboard, Device, Order, Process, Recovery, Row, Sick, Stop

__all__ = ["TABLE", "page"]

ONE: Final = STRUCK["dynamixel"]
_AFTER_SILENCE: Final = {
    "dynamixel": Recovery.NOTHING,
    "cia402": Recovery.ENABLE,
    "robotiq": Recovery.ACTIVATE,
    "feetech": Recovery.NOTHING,
    "odrive": Recovery.ENABLE,
    "damiao": Recovery.ENABLE,
    "ur": Recovery.NOTHING,
}
_AFTER_FAULT: Final = _AFTER_SILENCE | {"dynamixel": Recovery.ENABLE, "feetech": Recovery.ENABLE}
_SICK: Final = "its driver's process is not healthy"
_REPLUG: Final = "plug its adapter in again"


def _silent(device: Device, fault: str, *strike: Order, stop: Stop = Stop.HOLD, after: Recovery | None = None) -> Row:
    after = after or _AFTER_SILENCE[device]
    return Row(device, fault, strike, DeviceSilent, "did not answer", DeviceSilent, stop, DeviceSilent, after)


def _gone(device: Device, says: str, stop: Stop, after: Recovery, bus_health: str = "healthy") -> Row:
    row = Row(device, "unplug and replug", (Unplug(),), BusGone, says, BusGone, stop, BusGone, after)
    return row._replace(cure=(Replug(),), bus_health=bus_health)


def _faulty(device: Device, fault: str, strike: Order, says: str, stop: Stop, after: Recovery | None = None) -> Row:
    return Row(device, fault, (strike,), DeviceFault, says, says, stop, None, after or _AFTER_FAULT[device])


def _forgiven(device: Device, fault: str, strike: Order) -> Row:
    return Row(device, fault, (strike,), None, stop=Stop.NOTHING, recovery=Recovery.NOTHING)


def _swapped(device: Device, number: int, found: str, stop: Stop) -> Row:
    ids = STRUCK[device]
    row = _silent(device, "wrong device", Absent(ids=ids), stop=stop, after=_AFTER_FAULT[device])
    return row._replace(then=(WrongModel(ids=ids, number=number), Absent(ids=ids, on=False)), found=found)


def _sick(device: Device, fault: str, stop: Stop) -> Row:
    row = Row(device, fault, (Sick(),), MotionStopped, _SICK, DeviceFault, stop, DeviceFault, _AFTER_FAULT[device])
    return row._replace(cure=(Sick(on=False),))


_DYNAMIXEL: Final = (
    _silent("dynamixel", "silence", Mute(ids=ONE)),
    _silent("dynamixel", "late, always", Late(ids=ONE, s=1.0)),
    _forgiven("dynamixel", "late, once", Late(ids=ONE, s=0.04, count=1)),
    _silent("dynamixel", "corrupt, always", BadCrc(ids=ONE)),
    _forgiven("dynamixel", "corrupt, once", BadCrc(ids=ONE, count=1)),
    _silent("dynamixel", "cut short", Truncate(ids=ONE)),
    _forgiven("dynamixel", "garbage before answers", Garbage(ids=ONE, count=30)),
    _silent("dynamixel", "garbage for answers", Garbage(ids=ONE), Truncate(ids=ONE, missing=999)),
    _faulty("dynamixel", "frozen value", Freeze(ids=ONE), "it makes no progress", Stop.HOLD),
    _faulty(
        "dynamixel", "frozen clock", Freeze(ids=ONE, tick=True), "its clock jumped, or it makes no progress", Stop.HOLD
    ),
    _faulty("dynamixel", "blocked", Jam(ids=ONE), "it makes no progress", Stop.BLOCKED),
    _silent("dynamixel", "cable off", Absent(ids=ONE), stop=Stop.WATCHDOG, after=Recovery.ENABLE),
    _gone("dynamixel", _REPLUG, Stop.WATCHDOG, Recovery.ENABLE),
    _faulty("dynamixel", "fault latched", HardwareFault(ids=ONE, bits=0x20), "overload", Stop.ITSELF),
    _faulty("dynamixel", "over-temperature", Supply(ids=ONE, temperature_c=80), "overheating", Stop.ITSELF)._replace(
        cure=(Supply(ids=ONE, temperature_c=30),)
    ),
    _swapped("dynamixel", 1020, "another model answers with its id", Stop.WATCHDOG),
    Row("dynamixel", "restart", (BrownOut(ids=ONE),), DeviceError, "", "it has restarted", Stop.ITSELF),
    _sick("dynamixel", "watchdog", Stop.BOTH),
)
_CIA402: Final = (
    _silent("cia402", "silence", Mute(ids=ONE)),
    _silent("cia402", "no measurements", Mute(ids=ONE, instruction="tpdo1")),
    _silent("cia402", "heartbeat lost", Mute(ids=ONE, instruction="heartbeat")),
    _silent("cia402", "late, always", Late(ids=ONE, s=1.0)),
    _forgiven("cia402", "late, within a cycle", Late(ids=ONE, instruction="tpdo1", s=0.004)),
    _silent("cia402", "corrupt, always", BadCrc(ids=ONE), stop=Stop.WATCHDOG),
    _forgiven("cia402", "corrupt, five times", BadCrc(ids=ONE, instruction="tpdo1", count=5)),
    _silent("cia402", "cut short", Truncate(ids=ONE, instruction="tpdo1")),
    _silent("cia402", "garbage for measurements", Garbage(ids=ONE, instruction="tpdo1")),
    _faulty("cia402", "frozen value", Freeze(ids=ONE), "it makes no progress", Stop.HOLD)._replace(
        stop_error=DeviceFault
    ),
    _faulty("cia402", "blocked", Jam(ids=ONE), "error 8611h, following error", Stop.ITSELF),
    _silent("cia402", "cable off", Absent(ids=ONE), stop=Stop.WATCHDOG),
    _gone("cia402", "", Stop.WATCHDOG, Recovery.ENABLE, "degraded: CAN bus gone"),
    _silent("cia402", "bus-off of the drive", BusOff(ids=ONE), stop=Stop.ITSELF),
    Row(
        "cia402",
        "bus-off of the adapter",
        (BusOff(),),
        BusGone,
        "bus-off: too many errors",
        DeviceSilent,
        Stop.WATCHDOG,
        DeviceSilent,
        cure=(BusOff(on=False),),
        bus_health="degraded: CAN bus-off",
    ),
    _faulty("cia402", "EMCY", Emergency(ids=ONE, code=0x2310), "error 2310h, continuous over-current", Stop.ITSELF),
    _faulty(
        "cia402",
        "fault latched",
        Emergency(ids=ONE, code=0x3220, lasting=True),
        "error 3220h, under-voltage",
        Stop.ITSELF,
    ),
    _faulty(
        "cia402",
        "over-temperature",
        Supply(ids=ONE, temperature_c=90),
        "error 4310h, over-temperature",
        Stop.ITSELF,
    ),
    _swapped("cia402", 77, "another drive answers as node 1", Stop.WATCHDOG),
    Row("cia402", "restart", (BrownOut(ids=ONE),), DeviceError, "", "it has restarted", Stop.ITSELF),
    _sick("cia402", "watchdog", Stop.BOTH),
)
_ROBOTIQ: Final = (
    _silent("robotiq", "silence", Mute()),
    _silent("robotiq", "late, always", Late(s=1.0)),
    _forgiven("robotiq", "late, once", Late(s=0.06, count=1)),
    _silent("robotiq", "corrupt, always", BadCrc()),
    _forgiven("robotiq", "corrupt, once", BadCrc(count=1)),
    _silent("robotiq", "cut short", Truncate()),
    _forgiven("robotiq", "garbage before answers", Garbage(hex="09040600ff", count=30)),
    _silent("robotiq", "garbage for answers", Garbage(), Truncate(missing=999)),
    _faulty("robotiq", "frozen value", Freeze(), "its fingers stand", Stop.HOLD),
    _silent("robotiq", "cable off", Absent(), stop=Stop.GOAL, after=Recovery.NOTHING),
    _gone("robotiq", _REPLUG, Stop.GOAL, Recovery.NOTHING),
    _faulty("robotiq", "fault latched", HardwareFault(bits=0x0E), "overcurrent", Stop.ITSELF),
    _faulty("robotiq", "over-temperature", Supply(temperature_c=90), "too hot", Stop.ITSELF),
    _faulty("robotiq", "under-voltage", Supply(voltage_v=20.0), "supply voltage is too low", Stop.ITSELF),
    _swapped("robotiq", 0, "it is no 2F-85", Stop.GOAL),
    Row("robotiq", "restart", (BrownOut(),), DeviceFault, "activat", "", Stop.ITSELF, None, Recovery.ACTIVATE),
    _sick("robotiq", "sick driver", Stop.HOLD)._replace(recovery=Recovery.NOTHING),
)
_FEETECH: Final = (
    _silent("feetech", "silence", Mute(ids=ONE), stop=Stop.UNTOLD),
    _silent("feetech", "late, always", Late(ids=ONE, s=1.0), stop=Stop.UNTOLD),
    _forgiven("feetech", "late, once", Late(ids=ONE, s=0.04, count=1)),
    _silent("feetech", "corrupt, always", BadCrc(ids=ONE), stop=Stop.UNTOLD),
    _forgiven("feetech", "corrupt, once", BadCrc(ids=ONE, count=1)),
    _silent("feetech", "cut short", Truncate(ids=ONE), stop=Stop.UNTOLD),
    _forgiven("feetech", "garbage before answers", Garbage(ids=ONE, hex="ffff0108", count=30)),
    _silent("feetech", "garbage for answers", Garbage(ids=ONE), Truncate(ids=ONE, missing=999), stop=Stop.UNTOLD),
    _faulty("feetech", "frozen value", Freeze(ids=ONE), "it makes no progress", Stop.HOLD),
    _faulty("feetech", "blocked", Jam(ids=ONE), "it makes no progress", Stop.HOLD),
    _silent("feetech", "cable off", Absent(ids=ONE), stop=Stop.NEAR),
    _gone("feetech", _REPLUG, Stop.NEAR, Recovery.NOTHING),
    _faulty("feetech", "fault latched", HardwareFault(ids=ONE, bits=0x20), "overload", Stop.ITSELF),
    _faulty("feetech", "over-temperature", Supply(ids=ONE, temperature_c=80), "overheating", Stop.ITSELF)._replace(
        cure=(Supply(ids=ONE, temperature_c=30),)
    ),
    _faulty("feetech", "over-voltage", Supply(ids=ONE, voltage_v=9.0), "input voltage", Stop.HOLD)._replace(
        cure=(Supply(ids=ONE, voltage_v=7.4),)
    ),
    _swapped("feetech", 1285, "another model answers with its id", Stop.NEAR),
    Row("feetech", "restart", (BrownOut(ids=ONE),), DeviceError, "", "its torque went off", Stop.ITSELF),
    _sick("feetech", "sick driver", Stop.HOLD)._replace(recovery=Recovery.NOTHING),
)
_ODRIVE: Final = (
    _silent("odrive", "silence", Mute(ids=ONE)),
    _silent("odrive", "no measurements", Mute(ids=ONE, instruction="get_encoder_estimates")),
    _silent("odrive", "heartbeat lost", Mute(ids=ONE, instruction="heartbeat")),
    _silent("odrive", "late, always", Late(ids=ONE, s=1.0)),
    _silent("odrive", "corrupt, always", BadCrc(ids=ONE), stop=Stop.WATCHDOG),
    _silent("odrive", "cut short", Truncate(ids=ONE, instruction="get_encoder_estimates")),
    _faulty("odrive", "frozen value", Freeze(ids=ONE), "it makes no progress", Stop.HOLD),
    _faulty("odrive", "blocked", Jam(ids=ONE), "it makes no progress", Stop.HOLD),
    _silent("odrive", "cable off", Absent(ids=ONE), stop=Stop.WATCHDOG),
    _gone("odrive", "", Stop.WATCHDOG, Recovery.ENABLE, "degraded: CAN bus gone"),
    _silent("odrive", "bus-off of the axis", BusOff(ids=ONE), stop=Stop.WATCHDOG),
    _faulty("odrive", "error", Emergency(ids=ONE, code=0x1000), "current limit", Stop.ITSELF),
    _faulty("odrive", "under-voltage", Supply(ids=ONE, voltage_v=9.0), "under voltage", Stop.ITSELF),
    _faulty("odrive", "over-temperature", Supply(ids=ONE, temperature_c=120), "inverter too hot", Stop.ITSELF),
    _swapped("odrive", 4, "product line 4", Stop.WATCHDOG),
    Row("odrive", "restart", (BrownOut(ids=ONE),), DeviceError, "", "torque went off", Stop.ITSELF),
    _sick("odrive", "watchdog", Stop.BOTH),
)
_DAMIAO: Final = (
    _silent("damiao", "silence", Mute(ids=ONE)),
    _silent("damiao", "late, always", Late(ids=ONE, s=1.0)),
    _silent("damiao", "corrupt, always", BadCrc(ids=ONE), stop=Stop.WATCHDOG),
    _silent("damiao", "cut short", Truncate(ids=ONE)),
    _faulty("damiao", "frozen value", Freeze(ids=ONE), "it makes no progress", Stop.HOLD),
    _faulty("damiao", "blocked", Jam(ids=ONE), "it makes no progress", Stop.HOLD),
    _silent("damiao", "cable off", Absent(ids=ONE), stop=Stop.WATCHDOG),
    _gone("damiao", "", Stop.WATCHDOG, Recovery.ENABLE, "degraded: CAN bus gone"),
    _silent("damiao", "bus-off of the motor", BusOff(ids=ONE), stop=Stop.WATCHDOG),
    _faulty("damiao", "fault latched", HardwareFault(ids=ONE, bits=0xE), "overload", Stop.ITSELF),
    _faulty("damiao", "under-voltage", Supply(ids=ONE, voltage_v=9.0), "under voltage", Stop.ITSELF),
    _faulty("damiao", "over-temperature", Supply(ids=ONE, temperature_c=130), "rotor too hot", Stop.ITSELF),
    _swapped("damiao", 30, "the position of a DM4310", Stop.WATCHDOG),
    Row("damiao", "restart", (BrownOut(ids=ONE),), DeviceError, "", "torque went off", Stop.ITSELF),
    _sick("damiao", "watchdog", Stop.BOTH),
)
_MADE_NORMAL: Final = (HardwareFault(bits=1),)


def _arm_stopped(fault: str, strike: Order, says: str, after: Recovery, cure: tuple[Order, ...] = (Heal(),)) -> Row:
    return Row("ur", fault, (strike,), DeviceFault, says, says, Stop.ITSELF, None, after, cure=cure)


def _arm_relaxed(fault: str, *strike: Order, stop: Stop = Stop.PROGRAM, cure: tuple[Order, ...] = (Heal(),)) -> Row:
    return Row("ur", fault, strike, DeviceError, "", "", stop, None, Recovery.NOTHING, cure=cure, refuses=False)


def _arm_gone(fault: str, strike: Order, cure: Order, stop: Stop) -> Row:
    row = Row("ur", fault, (strike,), DeviceError, "", DeviceSilent, stop, DeviceSilent, Recovery.NOTHING)
    return row._replace(cure=(cure,))


_UR: Final = (
    _silent("ur", "silence", Mute(instruction="data"), stop=Stop.HOLD_OR_PROGRAM),
    _silent("ur", "frozen clock", Freeze(tick=True)),
    _silent("ur", "late, always", Late(s=1.0, instruction="data"), stop=Stop.HOLD_OR_PROGRAM),
    _forgiven("ur", "late, a little", Late(s=0.02, instruction="data")),
    _arm_relaxed("frozen value", Freeze(), stop=Stop.HOLD)._replace(error=DeviceFault, says="it makes no progress"),
    _silent("ur", "noise", Garbage(instruction="data"), stop=Stop.HOLD_OR_PROGRAM),
    _arm_relaxed("RTDE link lost", HangUp(kind="rtde")),
    _arm_gone("network cut", Absent(), Absent(on=False), Stop.WATCHDOG),
    _arm_gone("connections dropped", Unplug(), Replug(), Stop.WATCHDOG),
    _forgiven("ur", "dashboard lost", Mute(instruction="dashboard")),
    _arm_relaxed("control process killed", Process("KILL")),
    _arm_relaxed("control process hung", Process("STOP")),
    _arm_relaxed("program ended by another client", Dashboard("stop"), stop=Stop.ITSELF),
    _arm_relaxed("remote control off, then killed", Local(), Process("KILL"), stop=Stop.WATCHDOG)._replace(
        refuses=True, cure=(Local(on=False),)
    ),
    _arm_relaxed("script refused, then killed", Mute(instruction="script"), Process("KILL"))._replace(refuses=True),
    _arm_stopped("protective stop", HardwareFault(bits=3), "protective stop", Recovery.UNLOCK),
    _arm_stopped("blocked", Jam(), "protective stop", Recovery.UNLOCK),
    _arm_stopped("safeguard stop", HardwareFault(bits=5), "safeguard stop", Recovery.NOTHING, _MADE_NORMAL),
    _arm_stopped("emergency stop", HardwareFault(bits=7), "emergency stop", Recovery.START, _MADE_NORMAL),
    _arm_stopped("emergency stop of its system", HardwareFault(bits=6), "emergency stop", Recovery.START, _MADE_NORMAL),
    _arm_stopped("safety fault", HardwareFault(bits=9), "fault", Recovery.START, _MADE_NORMAL),
    _arm_stopped("power switched off", Dashboard("power off"), "its power is off", Recovery.START),
    _arm_stopped("restart", BrownOut(), "", Recovery.START)._replace(error=DeviceError, state="its power is off"),
    _sick("ur", "sick driver", Stop.HOLD)._replace(recovery=Recovery.NOTHING),
)
TABLE: Final = (*_DYNAMIXEL, *_CIA402, *_ROBOTIQ, *_FEETECH, *_ODRIVE, *_DAMIAO, *_UR)

_TITLES: Final = {
    "dynamixel": "Dynamixel servos",
    "cia402": "CiA 402 drives",
    "robotiq": "2F-85 grippers",
    "feetech": "Feetech servos",
    "odrive": "ODrives",
    "damiao": "Damiao motors",
    "ur": "Arms of Universal Robots",
}
_HEAD: Final = """# Faults

For operators and technicians whose robot reports a fault.
After reading, you know what happens when a device fails during a move, and what to do before it moves again.

In every row, **nothing moves** until you have fixed the cause and made the calls in the last column. When a device
answers again, the driver does not enable it and sends it no goal. At most, it makes the device hold its position.

| column | meaning |
|---|---|
| *caused by* | the orders for the [simulator](simulators.md#faults) that cause the fault in the device that moves |
| *the move ends with* | the error of the call. Until the fault ends, new moves fail, too, unless "over at once" |
| *state()*, *stop()* | results while the fault lasts. If `stop()` raises an error, the device may still move |
| *stopped by* | what ends the motion in progress |
| *then* | the services to call once the cause is fixed |

Three orders are not from the simulator:

- `sick`: the container is not healthy.
- `process signal`: a signal to the control process of an arm's driver.
- `dashboard`: a line that another client sends to the arm's controller.

A fault of one joint does not affect other joints on its bus. The exception is a group that moves: all its joints stop.

In the registry, a device with a fault is `degraded: ` followed by the fault. A device that is offline is
`degraded: silent` or `degraded: bus gone`. A group with such a member is degraded, too. If a CAN bus is not healthy,
all its devices report that. TRADE keeps each fault with its measurements ([drivers](drivers.md#what-was-wrong)).

`fault_table.py`, beside the tests of the drivers, writes this page. Two tests check each row against the simulator's
log: `test_a_fault_while_moving_ends_the_move_and_nothing_moves_on_recovery` and `test_a_small_fault_goes_unnoticed`.
"""
_COLUMNS: Final = ("fault", "caused by", "the move ends with", "state()", "stop()", "stopped by", "then")


def page() -> str:
    """The page of the docs."""
    return "".join([_HEAD, *(line for device in _TITLES for line in _section(device))])


def _section(device: str) -> Iterator[str]:
    yield f"\n## {_TITLES[device]}\n\n"
    yield f"| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|\n"
    for row in TABLE:
        if row.device == device:
            yield f"| {' | '.join(_cells(row))} |\n"


def _cells(row: Row) -> tuple[str, ...]:
    then = f'; when it is detected, {_orders(row, row.then)}: fault "{row.found}"' if row.then else ""
    health = "" if row.bus_health == "healthy" else f'; in the registry "{row.bus_health}"'
    if row.error is None:
        return row.fault, _orders(row, row.strike), "no error: it reaches its goal", "no fault", "no error", *_end(row)
    error = (
        f"`{row.error.__name__}`" + (f': "{row.says}"' if row.says else "") + ("" if row.refuses else "; over at once")
    )
    stop = "no error" if row.stop_error is None else f"`{row.stop_error.__name__}`"
    return row.fault, _orders(row, row.strike) + then, error, _state(row) + health, stop, *_end(row)


def _end(row: Row) -> tuple[str, str]:
    return row.stop.value, row.recovery.value


def _state(row: Row) -> str:
    if isinstance(row.state, type):
        return f"`{row.state.__name__}`"
    return f'fault "{row.state}"' if row.state else "no fault"


def _orders(row: Row, orders: tuple[Order, ...]) -> str:
    return ", ".join(_order(order, STRUCK[row.device]) for order in orders)


def _order(order: Order, struck: tuple[int, ...]) -> str:
    """An order as one would write it, without what is usual."""
    fields = msgspec.structs.fields(order)
    reported = [
        f"{field.name} {getattr(order, field.name)}"
        for field in fields
        if getattr(order, field.name) not in (field.default, struck)
    ]
    return f"`{' '.join([str(order.__struct_config__.tag), *reported])}`"


if __name__ == "__main__":
    print(page(), end="")
