"""Checks of ``trade doctor`` on a robot: its lines, its devices, and their watchdogs."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers import (
    Bench,
    CanBus,
    Commissioner,
    Driver,
    Joint,
    Robot,
    ScannedDevice,
    SerialBus,
    UrBus,
    WireError,
    load_driver,
)
from trade_drivers.bus._jobs import SHARED, TAKEN
from trade_drivers.plugins._ports import SeenPorts, check_ports
from trade_gateway.cli.hardware._doctor_host import Finding
from trade_gateway.cli.hardware._robot_file_template import UNMEASURED_RAD
from trade_robotfile import Gripper

if TYPE_CHECKING:
    from trade_drivers.bus.can import Link

_LOOKS: Final = 10
"""How often each device is asked: a bad line loses some answers."""
_PATIENCE_S: Final = 3.0
_NUMBERED: Final = re.compile(r"/dev/tty(USB|ACM)\d+")
_FRAMES: Final = 3
"""The frames that a drive gets at once, at the start of a group's motion."""
_QUEUE: Final = 128
"""A length of the send queue that suffices for all of this project's drivers."""
_BAD_LINE: Final = (
    "check the cable, its length and its ends: a long line needs a termination (120 ohm) at both ends only, "
    "a common ground, and one baud rate"
)


def unwatched(robot: Robot) -> Iterator[Finding]:
    """Reports devices without a watchdog that stops them when their driver ends."""
    for bus in robot.buses:
        without = load_driver(bus.driver, bus.name, Driver).without_watchdog
        named = [device.name for device in (*robot.joints_on(bus.name), *robot.grippers_on(bus.name))]
        if without and named:
            fix = "give the robot an emergency stop that cuts their power; docs/safety.md, S06"
            yield Finding(level="warning", about=", ".join(named), text=without, fix=fix)


def unmeasured(robot: Robot, path: Path) -> Iterator[Finding]:
    """Reports joints whose zero and range are still those that a scan writes."""
    lines = {bus.name for bus in robot.buses if isinstance(bus, SerialBus)}
    for joint in robot.joints:
        if (joint.offset_rad, joint.min_rad, joint.max_rad) == (0.0, -UNMEASURED_RAD, UNMEASURED_RAD):
            fix = (
                f"trade calibrate {path} {joint.name}"
                if joint.bus in lines
                else "measure them, and write them into the file"
            )
            text = "its zero and range are the placeholders that `trade scan` wrote"
            yield Finding(level="warning", about=joint.name, text=text, fix=fix)


def interfaces(robot: Robot) -> Iterator[Finding]:
    """Checks the CAN interfaces of the operating system: present, up, without errors, at the file's bit rate."""
    for bus in robot.buses:
        if not isinstance(bus, CanBus) or bus.interface != "socketcan":
            continue
        from trade_drivers.bus.can import look_at  # noqa: PLC0415 - python-can is optional

        try:
            yield judged(bus, look_at(bus.channel), len(robot.joints_on(bus.name)))
        except OSError as bad:
            fix = "plug its adapter in and load its kernel module; `ip link show type can` lists the interfaces"
            yield Finding(level="error", about=bus.channel, text=str(bad), fix=fix)


def judged(bus: CanBus, link: "Link", drives: int) -> Finding:
    """Returns the finding about a CAN interface with so many drives."""
    about = bus.channel
    up = f"sudo ip link set {about} up type can bitrate {bus.bitrate} restart-ms 100"
    if not link.up:
        return Finding(level="error", about=about, text="is down", fix=up)
    if link.bitrate is not None and link.bitrate != bus.bitrate:
        text = f"runs at {link.bitrate} bit/s, and the robot file says {bus.bitrate}"
        return Finding(level="error", about=about, text=text, fix=f"sudo ip link set {about} down; {up}")
    if link.state:
        text = f"its controller reports errors ({link.state.name.lower().replace('_', '-')})"
        fix = (
            "no device may be listening, or the ends are wrong: use two terminations of 120 ohm (60 ohm between CAN_H "
            f"and CAN_L without power), one bit rate for all, powered drives. Then: sudo ip link set {about} "
            f"down; {up}"
        )
        return Finding(level="error", about=about, text=text, fix=fix)
    if link.queue is not None and link.queue < _FRAMES * drives:
        text = f"its send queue holds {link.queue} frames (txqueuelen); {drives} drives may need {_FRAMES * drives}"
        fix = f"sudo ip link set {about} txqueuelen {max(_QUEUE, _FRAMES * drives)}, after each boot (docs/drivers.md)"
        return Finding(level="warning", about=about, text=text, fix=fix)
    return Finding(level="ok", about=about, text="is up" + (f" at {link.bitrate} bit/s" if link.bitrate else ""))


def shared(robot: Robot, seen: SeenPorts | None = None) -> Iterator[Finding]:
    """Reports two names of one port; ``seen`` has the ports of robots before this one."""
    try:
        check_ports(robot, seen=seen)
    except ConfigurationError as bad:
        yield Finding(level="error", about="ports", text=str(bad), fix="correct one of the two keys")


def numbered(robot: Robot, links: Path = Path("/dev/serial")) -> Iterator[Finding]:
    """Reports ports whose number depends on the order of plugging in: two adapters may swap theirs, and so two arms."""
    for bus in robot.buses:
        if not isinstance(bus, SerialBus) or not _NUMBERED.fullmatch(bus.port):
            continue
        device = Path(bus.port).resolve()
        lasting = [link for kind in ("by-id", "by-path") for link in sorted(links.glob(f"{kind}/*"))]
        name = next((str(link) for link in lasting if link.resolve() == device), "its name in /dev/serial/by-id")
        text = f"its port is {bus.port}, which may be another adapter after the next start or replugging"
        yield Finding(level="warning", about=f"bus {bus.name}", text=text, fix=f"write port = {name!r}")


def refused(robot: Robot, refusals: Mapping[str, ConfigurationError]) -> Iterator[Finding]:
    """Reports the errors that drivers find in the file, before any device is asked."""
    buses = {bus.name for bus in robot.buses}
    for part, refusal in refusals.items():
        about, then = (f"bus {part}", "; its line was not checked, so run this again") if part in buses else (part, "")
        yield Finding(level="error", about=about, text=str(refusal), fix=f"correct the file{then}")


def devices(robot: Robot) -> Iterator[Finding]:
    """Checks whether the devices on serial lines answer reliably and match the file. Writes nothing to them."""
    for bus in robot.buses:
        driver = load_driver(bus.driver, bus.name, Driver)
        if not isinstance(bus, SerialBus) or driver.commissioner is None:
            continue
        if not Path(bus.port).exists():
            fix = "plug its adapter in; `trade scan` lists the ports, /dev/serial/by-id has lasting names"
            yield Finding(level="error", about=f"bus {bus.name}", text=f"there is no {bus.port}", fix=fix)
            continue
        try:
            yield from _on_line(robot, bus, driver, driver.commissioner())
        except ConfigurationError as bad:
            yield _unseen(robot, bus, bad)


def _unseen(robot: Robot, bus: SerialBus, bad: ConfigurationError) -> Finding:
    """Returns the finding about a line that could not be opened."""
    about = f"bus {bus.name}"
    if TAKEN in bad.problem:
        fix = "end the program that uses it and run this again; while a robot is up, `trade up` reports its devices"
        return Finding(level="warning", about=about, text=f"was not checked: {bad}", fix=fix)
    text = f"was not checked: {robot.where}: bus.{bus.name}.port: {bad.problem}"
    if SHARED in bad.problem:
        fix = "end it and keep it away: ModemManager by ID_MM_DEVICE_IGNORE in a udev rule, a getty by systemctl"
        return Finding(level="error", about=about, text=text, fix=fix)
    return Finding(
        level="error", about=about, text=text, fix="set port to the line of these devices, and run this again"
    )


def _on_line(robot: Robot, bus: SerialBus, driver: Driver, commissioner: Commissioner) -> Iterator[Finding]:
    with commissioner.at(bus.port, bus.baud) as bench:
        for device in (*robot.joints_on(bus.name), *robot.grippers_on(bus.name)):
            found = _of_device(bench, device, bus)
            yield found if found.level != "ok" else _unfit(driver, bench, robot, bus, device, found.about) or found


def _unfit(
    driver: Driver, bench: Bench, robot: Robot, bus: SerialBus, device: Joint | Gripper, about: str
) -> Finding | None:
    """Returns what `trade up` or `enable` would refuse about a device that answers, or None."""
    try:
        driver.fits(bench, robot, bus, device)
    except ConfigurationError as bad:
        return Finding(level="error", about=about, text=str(bad), fix="set the device up so, or correct the file")
    except WireError as bad:
        return Finding(level="error", about=about, text=f"answers, but not always: {bad}", fix=_BAD_LINE)
    return None


def _of_device(bench: Bench, device: Joint | Gripper, bus: SerialBus) -> Finding:
    about = f"{device.name} (id {device.id} on bus {bus.name})"
    looks = [bench.look(device.id) for _ in range(_LOOKS)]
    good = [found for found in looks if found is not None and not found.problem]
    if not any(looks):
        fix = f"check its power and cable; `trade scan --port {bus.port}` shows the id and rate that it answers at"
        return Finding(level="error", about=about, text=f"does not answer at {bus.baud} baud", fix=fix)
    if not good:
        problem = Counter(found.problem for found in looks if found is not None).most_common(1)[0][0]
        return Finding(level="error", about=about, text="cannot be used", fix=problem)
    if len(good) < _LOOKS:
        text = f"answered {len(good)} of {_LOOKS} requests correctly"
        return Finding(level="error", about=about, text=text, fix=_BAD_LINE)
    return _identity(about, device, good[0])


def _identity(about: str, device: Joint | Gripper, found: ScannedDevice) -> Finding:
    firmware = device.firmware if isinstance(device, Joint) else None
    for key, expected, actual in (("model", device.model, found.model), ("firmware", firmware, found.firmware)):
        if expected is not None and expected != actual:
            text = f"its {key} is {actual}, and the robot file says {expected}"
            fix = f"attach the intended device, or correct {key} and calibrate it"
            return Finding(level="error", about=about, text=text, fix=fix)
    identity = f"{found.model}, firmware {found.firmware}," if found.firmware else found.model
    return Finding(level="ok", about=about, text=f"{identity} answers")


def controllers(robot: Robot) -> Iterator[Finding]:
    """Checks whether the controllers of arms are reachable, with each service that `trade up` needs."""
    for bus in robot.buses:
        if isinstance(bus, UrBus):
            yield from _services(bus.host)


def _services(host: str) -> Iterator[Finding]:
    from trade_drivers.vendors.ur import SERVICES, lacking, remedy  # noqa: PLC0415 - loads what others do not need

    problems = lacking(host, _PATIENCE_S)
    if problems.keys() == SERVICES.keys():
        fix = "switch it on and connect it to this network; on its screen: Settings, System, Network"
        yield Finding(level="error", about=host, text=f"cannot be reached: {next(iter(problems.values()))}", fix=fix)
        return
    for name, why in problems.items():
        yield Finding(level="error", about=host, text=f"has no {SERVICES[name]}: {why}", fix=remedy(name))
    if not problems:
        yield Finding(level="ok", about=host, text=f"can be reached: {', '.join(SERVICES.values())}")
