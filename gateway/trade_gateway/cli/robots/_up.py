"""``trade up ROBOT.toml``: attaches a robot's devices and offers them as services until it is ended."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.markup import escape

from trade import Container
from trade.errors import ConfigurationError, as_commands
from trade_drivers import AttachedRobot, FaultInfo, attach, load, without
from trade_drivers import check as drivers_check
from trade_drivers.plugins._ports import check_ports
from trade_gateway._usage import UsageError
from trade_gateway.cli.robots._bus_processes import BusProcesses
from trade_gateway.cli.robots._child_news import say_news
from trade_gateway.process._real_time import RealTime
from trade_gateway.process._signals import leaving, refuse_twice, settle
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import CONNECTION, SELECT, Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._sd_notify import Notifier
from trade_gateway.terminal._system_choice import choice_of
from trade_robotfile import Robot

_SIMULATION: Final = "Simulation"


class FaultWatch:
    """Reports changes in the faults of a robot.

    Args:
        robot: the robot.
        open_faults: returns its open faults.
    """

    def __init__(self, robot: Robot, open_faults: Callable[[], Sequence[FaultInfo]]) -> None:
        self._open_faults = open_faults
        self._remedies = {f"{robot.name}.{joint.name}": "enable" for joint in robot.joints}
        self._remedies |= {f"{robot.name}.{gripper.name}": "activate" for gripper in robot.grippers}
        """By device, the service that clears a fault once its cause is gone."""
        self._known: dict[str, FaultInfo] = {}
        """By device, the fault that was reported."""

    def begin(self, out: Output) -> None:
        """Reports the open faults, or that there are none."""
        if not self.report(out):
            out.say(f"{_now():%H:%M:%S} no joint has a fault")

    def report(self, out: Output) -> bool:
        """Reports what has changed since the last time, the newest fault of each device; returns whether any has."""
        found = reversed(self._open_faults())
        now = {info.device: info for info in found}
        before, self._known = self._known, now
        changed = [device for device in {**before, **now} if _kind(before.get(device)) != _kind(now.get(device))]
        for device in changed:
            self._say(out, device, now.get(device))
        return bool(changed)

    def _say(self, out: Output, device: str, info: FaultInfo | None) -> None:
        text = "" if info is None else self._sentence(info)
        if out.as_json:
            out.data({"at": _now().isoformat(timespec="milliseconds"), "joint": device, "fault": text})
        elif info is None:
            out.say(f"{_now():%H:%M:%S} [green]{device}: healthy again[/]")
        else:
            out.say(f"{_now():%H:%M:%S} [bold red]{escape(text)}[/]")

    def _sentence(self, info: FaultInfo) -> str:
        call = self._remedies.get(info.device)
        if not info.remedy or call is None:
            return f"{info.text}; {as_commands(info.device, info.remedy)}" if info.remedy else info.text
        end = "" if info.text.endswith("?") else "."
        return f"{info.text}{end} When you have looked: trade call {info.device}.{call}"


def _kind(info: FaultInfo | None) -> str:
    return "" if info is None else info.kind


def _now() -> datetime:
    return datetime.now().astimezone()


_LOOK_EVERY_S = 0.5


def up(
    context: typer.Context,
    robot_file: Annotated[Path, typer.Argument(metavar="ROBOT.toml", help="The robot file.")],
    sim: Annotated[
        bool,
        typer.Option("--sim", rich_help_panel=_SIMULATION, help="Simulate the devices: the same bytes, no hardware."),
    ] = False,
    sim_log: Annotated[
        Path | None, typer.Option(rich_help_panel=_SIMULATION, help="File for the simulator's log of all bytes.")
    ] = None,
    port: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PART=PORT",
            rich_help_panel=CONNECTION,
            help="Port instead of the file's: neck=/dev/ttyUSB1. Repeatable.",
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            "--without", metavar="PART", rich_help_panel=SELECT, help="Bus, camera or sensor to leave out. Repeatable."
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the container. Default: the robot's.")] = None,
    no_real_time: Annotated[
        bool, typer.Option("--no-real-time", help="Keep ordinary priority, and do not lock memory.")
    ] = False,
    check: Annotated[bool, typer.Option("--check", help="Check the file with its drivers, and exit.")] = False,
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Start a robot and keep it up until Ctrl-C or SIGTERM.

    The robot is left as its file says (hold or relax). Attaching moves nothing and resets nothing.
    A line reports each fault of a joint, and its end.
    Without --sim, the process runs in real time (SCHED_FIFO) if this user may; `trade doctor` shows whether.

    For example: trade up examples/rosie.toml --sim
    """
    if sim_log is not None and not sim:
        raise UsageError(where="--sim-log", problem="needs --sim: it is the simulator's log")
    if sim and port:
        raise UsageError(where="--port", problem="names hardware, which --sim simulates; leave one of them out")
    out = Output(as_json=as_json)
    whole, left_out = without(load(robot_file), leave_out or [])
    own = whole.own_processes()
    robot = without(whole, own)[0]
    named_ports = ports_named(port or [])
    if check:
        drivers_check(whole)
        out.say(f"{robot_file} is right")
        return
    if not sim:
        check_ports(whole, named_ports)
    if detach:
        detach_now(out, choice_of(context).settings(name or robot.name))
        return
    with Notifier() as notifier, ExitStack() as stack:
        asked_to_leave = stack.enter_context(leaving())
        simulation = stack.enter_context(_simulation(whole, sim_log)) if sim else None
        ports: dict[str, str] = simulation.ports if simulation else named_ports
        settings = choice_of(context).settings(name or robot.name)
        container = stack.enter_context(Container(settings, on_terminate=asked_to_leave.set))
        container.make_default()  # drivers of other packages may look for services
        refuse_twice(container, "trade up")
        if left_out:
            out.say(f"[bold]{robot.name}[/]: left out: {', '.join(left_out)}")
        real_time = RealTime()
        _hurry(out, real_time, wanted=not (sim or no_real_time))
        options = _options(leave_out, ordinary=sim or no_real_time)
        processes = stack.enter_context(BusProcesses(container, whole, own, ports, options))
        _say_attaching(out, whole, robot, ports)
        attached = attach(robot, container, ports={part: port for part, port in ports.items() if part not in own})
        attached.faults.report = lambda _: None  # FaultWatch shows them, with the time
        stack.callback(_say_left, attached)
        stack.enter_context(attached)
        container.measured_by(attached.measures)
        processes.wait_until_up(asked_to_leave)
        settle()
        _say_ready(out, robot, container, simulation)
        faults = FaultWatch(whole, lambda: attached.faults.faults(open_only=True) + processes.faults())
        faults.begin(out)
        stack.callback(notifier.leaving)
        notifier.ready(f"{robot.name} is up in container {container.name}")
        while not asked_to_leave.wait(_LOOK_EVERY_S):
            faults.report(out)
            say_news(out, processes.news)
            real_time.watch()
            if container.healthy():
                notifier.alive()
            if simulation is not None and not simulation.running:
                raise ConfigurationError(where="simulation", problem="its process ended; start again")
        out.say("leaving")
        processes.leave()  # all buses stop at the same time


def _options(leave_out: Sequence[str] | None, *, ordinary: bool) -> list[str]:
    """Returns the options that the processes of single buses have, too."""
    words = [word for part in leave_out or () for word in ("--without", part)]
    return [*words, "--no-real-time"] if ordinary else words


def _hurry(out: Output, real_time: RealTime, *, wanted: bool) -> None:
    for problem in real_time.take() if wanted else ():
        out.say(f"not in real time: {escape(problem)}; `trade doctor` shows the remedy")


def ports_named(words: Sequence[str]) -> dict[str, str]:
    """Returns the ports that the command line names instead of the file's, by part of the robot.

    Raises:
        UsageError: a word is no PART=PORT, or names a part a second time.
    """
    ports: dict[str, str] = {}
    for word in words:
        part, _, port = word.partition("=")
        if not (part and port):
            raise UsageError(where=f"--port {word}", problem="is not PART=PORT, such as neck=/dev/ttyUSB1")
        if part in ports:
            raise UsageError(where=f"--port {word}", problem=f"{part} has {ports[part]} already")
        ports[part] = port
    return ports


def _simulation(robot: Robot, log: Path | None) -> Any:
    try:
        from trade_hil_sim import SimProcess, SimulationError, remove_leftovers  # noqa: PLC0415 - only needed without hardware
    except ImportError:
        raise ConfigurationError(where="--sim", problem="needs trade-hil-sim; pip install trade-hil-sim") from None
    remove_leftovers()
    try:
        parts = [part.name for part in (*robot.buses, *robot.cameras, *robot.sensors)]
        return SimProcess(robot.where, buses=parts, log=log, logged=log is not None)
    except SimulationError as problem:
        raise ConfigurationError(where=robot.where, problem=str(problem)) from None


def _say_left(attached: AttachedRobot) -> None:
    if unseen := attached.unseen():
        complain(f"shut down without confirmation that these are at rest: {', '.join(unseen)}")


def _say_attaching(out: Output, whole: Robot, robot: Robot, ports: dict[str, str]) -> None:
    for bus in whole.buses:
        if bus not in robot.buses:
            out.say(f"[bold]{robot.name}[/]: bus {bus.name} has a process of its own")
            continue
        devices = (*robot.joints_on(bus.name), *robot.grippers_on(bus.name))
        named = ", ".join(
            [
                *(f"{device.name} ({device.model}, id {device.id})" for device in devices),
                *(f"{arm.name} ({arm.model})" for arm in robot.arms_on(bus.name)),
            ]
        )
        attached = named or f'no device; a device on it has bus = "{bus.name}"'
        out.say(f"[bold]{robot.name}[/]: attaching bus {bus.name} on {ports.get(bus.name, bus.port)}: {attached}")
    for sense in (*robot.cameras, *robot.sensors):
        place = f" on {ports[sense.name]}" if sense.name in ports else ""
        out.say(f"[bold]{robot.name}[/]: attaching {type(sense).__name__.lower()} {sense.name} ({sense.driver}){place}")


def _say_ready(out: Output, robot: Robot, container: Container, simulation: Any) -> None:
    mine = [handle for handle in container.services() if handle.local and "trade" not in handle.groups]
    if out.as_json:
        extra = {"control": str(simulation.control_path)} if simulation else {}
        open_ones = [estop.id for estop in container.estops()]
        up_now = {**ready(container), "robot": robot.name, "estops": open_ones, **extra}
        out.data({**up_now, "services": [handle.label for handle in mine]})
        return
    out.say(f"[bold green]{robot.name} is up[/]: {len(mine)} services in container {container.name}")
    example = next((handle.label for handle in mine if handle.name in {"state", "read"}), None)
    if example:
        out.say(f"in another terminal: [bold]trade services --group {robot.name}[/] or [bold]trade call {example}[/]")
    if simulation:
        out.say(
            f"to inject faults into the simulator: trade-hil-sim --do {simulation.control_path} FAULT (--help has them)"
        )
    out.say("Ctrl-C leaves")
    for estop in container.estops():
        why = f": {escape(estop.reason)}" if estop.reason else ""
        out.say(f"[bold red]e-stop {estop.id} is open{why}; nothing moves before it is cleared[/]")
        out.say(f"when it is safe: [bold]trade estop --clear {estop.id}[/]")
