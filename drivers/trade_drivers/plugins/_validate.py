"""Validation of a robot file by its drivers, before any port is opened."""

from collections.abc import Iterator, Mapping

import trade_robotfile
from trade.errors import ConfigurationError
from trade_drivers._robot_file import robot_file_errors
from trade_drivers.plugins._driver import AnyDriver, Driver, SenseDriver, load_driver
from trade_drivers.plugins._ports import check_ports
from trade_robotfile import Bus, Robot


def check(robot: Robot, ports: Mapping[str, str] | None = None) -> None:
    """Has the drivers of a robot check its file, without access to any device.

    Args:
        robot: the robot.
        ports: replacements for the ports in the file, by bus or device.

    Raises:
        ConfigurationError: two keys name one port, or the first mistake that a driver found; names file and key.
    """
    check_ports(robot, ports)
    for _, refusal in refusals(robot):
        raise refusal


def refusals(robot: Robot) -> Iterator[tuple[str, ConfigurationError]]:
    """Yields, for each bus, camera and sensor, the first mistake that its driver found in the file."""
    parts = (*robot.buses, *robot.cameras, *robot.sensors)
    for part in parts:
        try:
            with robot_file_errors():
                _check_bus(robot, part) if isinstance(part, Bus) else _check_sense(part)
        except ConfigurationError as refusal:
            yield part.name, refusal


def own_clocks(robot: Robot) -> Iterator[tuple[str, str]]:
    """Yields the drivers of a robot that cannot be on virtual time, as keys of its file, each with the reason.

    Raises:
        ConfigurationError: a driver is missing.
    """
    parts = {f"bus.{bus.name}": bus.driver for bus in robot.buses}
    parts |= {sense.key: sense.driver for sense in (*robot.cameras, *robot.sensors)}
    for key, driver in parts.items():
        if why := load_driver(driver, f"{robot.where}: {key}.driver", AnyDriver).own_clock:
            yield f"{key}.driver", f"driver {driver}: {why}"


def _check_bus(robot: Robot, bus: trade_robotfile.SerialBus | trade_robotfile.CanBus | trade_robotfile.UrBus) -> None:
    driver = load_driver(bus.driver, f"{robot.where}: bus.{bus.name}.driver", Driver)
    devices = (*robot.joints_on(bus.name), *robot.grippers_on(bus.name), *robot.arms_on(bus.name))
    for device in devices:
        if not isinstance(device, driver.devices):
            kind, known = (
                type(device).__name__.lower(),
                " and ".join(f"{one.__name__.lower()}s" for one in driver.devices),
            )
            problem = f"bus {bus.name!r} has driver {bus.driver}, which has no {kind}s, only {known}"
            raise ConfigurationError(where=f'{robot.where}: {kind}."{device.name}".bus', problem=problem)
    if devices:
        driver.check(robot, bus)


def _check_sense(sense: trade_robotfile.Camera | trade_robotfile.Sensor) -> None:
    load_driver(sense.driver, f"{sense.where}: {sense.key}.driver", SenseDriver).check(sense)
