"""Metrics of buses and devices, from known values only, so that collection causes no bus traffic."""

from collections.abc import Iterator, Mapping

from trade import Measure
from trade.errors import DeviceError
from trade_drivers.bus._can_monitor import CanMonitor
from trade_drivers.interfaces._motion import Motor, MotorState
from trade_drivers.plugins._driver import AttachedBus
from trade_robotfile import Robot


def measures_of(robot: Robot, buses: Mapping[str, AttachedBus], providers: Mapping[str, object]) -> Iterator[Measure]:
    """Yields all metrics of a robot."""
    for name, bus in buses.items():
        yield from bus.measures(f"{robot.name}.{name}")
    for name, provider in providers.items():
        if isinstance(provider, Motor):
            yield from _of_motor(name, provider)
        elif isinstance(provider, CanMonitor):
            yield from _of_can(provider)


def _of_motor(name: str, motor: Motor) -> Iterator[Measure]:
    try:
        state: MotorState | None = motor.state()
    except DeviceError:  # the measurement is too old
        state = None
    of = {"device": name}
    yield Measure("device_up", "1: its measurements are fresh; 0: it is offline.", float(state is not None), of)
    if state is None:
        return
    yield Measure("device_fault", "1: it refuses to move until it is enabled again.", float(bool(state.fault)), of)
    if state.temperature_c is not None:
        yield Measure("device_temperature_celsius", "As the device measures it.", state.temperature_c, of)
    if state.voltage_v is not None:
        yield Measure("device_volts", "Of its supply.", state.voltage_v, of)


def _of_can(monitor: CanMonitor) -> Iterator[Measure]:
    state = monitor.bus_state()
    of = {"bus": state.name}
    yield Measure("can_load_ratio", "Share of the bit rate in the last second.", state.load, of)
    yield Measure("can_error_frames", "Received since it was attached.", state.error_frames, of, "counter")
    yield Measure("can_bus_offs", "How often it went bus-off.", state.bus_offs, of, "counter")
