"""``trade-hil-sim ROBOT.toml``: simulate the buses of a robot file until a signal ends it; ``--do`` injects a fault."""

import argparse
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import msgspec

from trade_hil_sim.control._client import SimControl
from trade_hil_sim.control._command_line import command_of, listing
from trade_hil_sim.control._process import Ready
from trade_hil_sim.control._server import ControlServer, State
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog
from trade_hil_sim.robot._bus_thread import ready
from trade_hil_sim.robot._factory_devices import fresh_bus
from trade_hil_sim.robot._robot import buses_of
from trade_robotfile import load

EPILOG = f"""\
When all ports can be opened, one line of JSON appears on standard output:
  {{"ready": true, "ports": {{"neck": "/tmp/trade-sim-x/neck"}}, "log": null, "control": "/tmp/trade-sim-x/_control"}}
Give such a port to any client in place of a real one. The control socket takes lines of JSON, for instance
  {{"do": "mute", "ids": [1]}}   {{"do": "unplug", "bus": "neck"}}   {{"do": "state"}}
SIGTERM, SIGINT, the end of --parent or (with --stdin) the end of standard input end the simulator.

With --do, send a fault to a running simulator; for instance
  trade-hil-sim --do /tmp/trade-sim-x/_control jam ids=1,2 bus=neck
  trade-hil-sim --do /tmp/trade-sim-x/_control heal
The exit code is 0 if it was carried out, 1 if the simulator refused it or does not run, 2 if the arguments are wrong.
Faults and orders, with their keys besides bus=NAME in brackets:
{listing()}
docs/simulators.md describes each.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the simulator; return its exit status: 0 after a signal, 2 if it could not start.

    With ``--do``, send a fault to a running simulator: 0 if it was carried out, 1 if not, 2 if the arguments are wrong.
    """
    options = _parser().parse_args(argv)
    if options.do is not None:
        return _strike(options)
    stop = _Stop()
    try:
        with ExitStack() as stack:
            stack.callback(stop.close)
            _run(options, stack, stop)
    except (SimulationError, OSError, ValueError) as problem:
        return _failed(problem, 2)
    return 0


def _strike(options: argparse.Namespace) -> int:
    control, *words = options.do
    try:
        if options.robot is not None or options.fresh or not words:
            raise SimulationError("--do takes the control socket of a running simulator, and a fault")
        command = command_of(words)
    except SimulationError as problem:
        return _failed(problem, 2)
    try:
        with SimControl(control) as simulator:
            if not isinstance(command, State):
                simulator.do(command)
                return 0
            for bus in simulator.state():
                sys.stdout.write(msgspec.json.encode(bus).decode() + "\n")
    except SimulationError as problem:
        return _failed(problem, 1)
    return 0


def _failed(problem: Exception, code: int) -> int:
    sys.stderr.write(f"trade-hil-sim: {problem}\n")
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="trade-hil-sim",
        description="Simulate the devices of a robot file, byte for byte, on pseudo-terminals.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("robot", type=Path, metavar="ROBOT.toml", nargs="?", help="the robot file")
    parser.add_argument(
        "--fresh",
        action="append",
        default=[],
        metavar="NAME=DRIVER:MODEL,...",
        help="a bus with devices as they leave the factory, all of one id; repeatable",
    )
    parser.add_argument("--bus", action="append", default=[], metavar="NAME", help="simulate only this bus; repeatable")
    parser.add_argument("--log", type=Path, metavar="FILE", help="append every byte and event to FILE, as JSON lines")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="put the ports here (default: a temporary directory)")
    parser.add_argument("--control", type=Path, metavar="PATH", help="control socket (default: DIR/_control)")
    parser.add_argument("--unpaced", action="store_true", help="answer as fast as possible, not at the baud rate")
    parser.add_argument(
        "--do",
        nargs="+",
        metavar=("CONTROL", "FAULT"),
        help="send a fault and its KEY=VALUE, listed below, to the simulator with this control socket",
    )
    parser.add_argument("--parent", type=int, metavar="PID", help="end when this process ends")
    parser.add_argument("--stdin", action="store_true", help="end when standard input ends")
    return parser


def _run(options: argparse.Namespace, stack: ExitStack, stop: "_Stop") -> None:
    if options.robot is None and not options.fresh:
        raise SimulationError("nothing to simulate; name a robot file, or buses with --fresh")
    directory = _directory(options.dir, stack)
    log = stack.enter_context(ByteLog(options.log, keep=False))
    paced = not options.unpaced
    buses = [fresh_bus(words, directory, log=log, paced=paced) for words in options.fresh]
    if options.robot is not None:
        buses += buses_of(load(options.robot), directory, names=options.bus, log=log, paced=paced)
    for bus in buses:
        stack.callback(bus.close)
        bus.open()
    control = stack.enter_context(ControlServer(options.control or directory / "_control", buses))
    announced = Ready(
        ready=True,
        ports={bus.name: str(bus.port) for bus in buses},
        log=None if options.log is None else str(options.log.absolute()),
        control=str(control.path),
    )
    gc.collect()
    gc.freeze()  # a later garbage collection of everything loaded would delay every device by as much as a deadline
    sys.stdout.write(msgspec.json.encode(announced).decode() + "\n")
    sys.stdout.flush()
    stop.wait(options.parent, sys.stdin.fileno() if options.stdin else None)


def _directory(wanted: Path | None, stack: ExitStack) -> Path:
    if wanted is not None:
        wanted.mkdir(parents=True, exist_ok=True)
        return wanted.absolute()
    made = Path(tempfile.mkdtemp(prefix="trade-sim-"))
    stack.callback(shutil.rmtree, made, ignore_errors=True)
    return made


class _Stop:
    """Waits until it must end: on a signal, the parent's end, or the end of standard input."""

    def __init__(self) -> None:
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_write, False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: None)  # else it ends the process
        signal.set_wakeup_fd(self._wake_write, warn_on_full_buffer=False)  # also for one that comes just before a wait

    def wait(self, parent: int | None, stdin: int | None) -> None:
        """Return when the simulator must end."""
        with ExitStack() as stack:
            watched = [self._wake_read]
            if parent is not None:
                try:
                    pidfd = os.pidfd_open(parent)
                except ProcessLookupError:
                    return
                stack.callback(os.close, pidfd)
                watched.append(pidfd)
            if stdin is not None:
                watched.append(stdin)
            while True:
                ended = ready(watched)
                if stdin in ended and os.read(stdin or 0, 4096):
                    ended.remove(stdin or 0)
                if ended:
                    return

    def close(self) -> None:
        """Restore the signal handlers and close the pipe."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)
        os.close(self._wake_read)
        os.close(self._wake_write)


if __name__ == "__main__":
    sys.exit(main())
