"""A second program that reads the serial port: it takes answers away, and the errors name it with its pid."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.tail_rig import TailRig, rig
from tests.unit.drivers.test_serial import Pair, pair
from trade.errors import DeviceSilent, TradeError
from trade_drivers.bus._holders import holders
from trade_drivers.bus._serial_port import LONGEST_WAIT_S, SerialLine
from trade_hil_sim import Absent, received

pytestmark = pytest.mark.realtime

__all__ = ["pair", "rig"]

READS = """
import os, sys
port = os.open(sys.argv[1], os.O_RDONLY | os.O_NOCTTY)
print("open", flush=True)
while os.read(port, 1):
    pass
"""
HOLDS = """
import os, sys
port = os.open(sys.argv[1], os.O_RDONLY | os.O_NOCTTY)
print("open", flush=True)
sys.stdin.read()
"""


@contextmanager
def other_program(path: str, program: str = READS) -> Iterator[int]:
    """Another process that has the port open; its pid."""
    process = subprocess.Popen(
        [sys.executable, "-c", program, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        yield process.pid
    finally:
        process.kill()
        process.communicate()


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(TradeError) as refused:
        act()
    return str(refused.value)


def test_bytes_that_another_reader_took_are_a_missing_answer_and_no_hang_up(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = SerialLine(pair.path, 1_000_000)
    line.open()
    thief = os.open(pair.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    poll, taken = line._poll, []

    class Slow:
        """The other reader is between the wake-up and the read."""

        def poll(self, timeout_ms: float) -> list[tuple[int, int]]:
            ready = poll.poll(timeout_ms)
            if ready and not taken:
                taken.append(os.read(thief, 64))
            return ready

    monkeypatch.setattr(line, "_poll", Slow())
    os.write(pair.far, b"answer")
    assert not line.more(LONGEST_WAIT_S)
    assert taken == [b"answer"]
    assert time.monotonic() - line.stolen_at < 1
    os.write(pair.far, b"next")
    assert line.more(LONGEST_WAIT_S)
    assert bytes(line.received) == b"next"
    os.close(thief)
    pair.unplug()
    with pytest.raises(OSError, match=r"hung up|Input/output"):
        line.more(LONGEST_WAIT_S)
    line.close()


def test_a_port_that_another_program_has_open_is_refused_with_its_name_and_pid_and_nothing_is_sent(
    rig: TailRig,
) -> None:
    rig.plug()
    with other_program(str(rig.sim.port), HOLDS) as pid:
        text = refusal(rig.attach)
    assert "bus.tail.port" in text
    assert f"(pid {pid})" in text
    assert "python" in text
    assert not received(rig.log)
    rig.attach()


def test_a_locked_port_names_the_process_that_locked_it(rig: TailRig) -> None:
    rig.plug()
    locks = (
        "import fcntl, os, sys\nport = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)\nfcntl.flock(port, fcntl.LOCK_EX)"
    )
    with other_program(str(rig.sim.port), f'{locks}\nprint("open", flush=True)\nsys.stdin.read()') as pid:
        text = refusal(rig.attach)
    assert "another driver owns this port" in text
    assert f"(pid {pid})" in text


def test_the_fault_of_a_joint_without_answers_names_the_other_program_and_ends_with_it(rig: TailRig) -> None:
    rig.plug()
    root = rig.attach().motor("tail.root")
    root.enable()

    def error() -> str:
        try:
            root.state()
        except DeviceSilent as silent:
            return str(silent)
        return ""

    with other_program(str(rig.sim.port), HOLDS) as pid:
        rig.sim.do(Absent(ids=(1,)))
        wait_until(lambda: f"(pid {pid})" in error(), "its answers are missing")
        assert "another program has this port open" in error()
        assert "plug its adapter in again" not in error()
    rig.sim.do(Absent(ids=(1,), on=False))
    wait_until(lambda: not error(), "it answers again")
    root.move_to(0.1)


def test_the_program_behind_a_pseudo_terminal_and_this_process_do_not_count(pair: Pair) -> None:
    near = os.open(pair.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    assert holders(pair.path) == []
    os.close(near)
    assert holders("/nowhere") == []


def test_a_port_that_is_unplugged_while_its_holders_are_sought_has_none(
    pair: Pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its link vanishes after the first look at it."""

    def unplugged(path: str, *_: object, **__: object) -> str:
        if path == str(port):
            raise FileNotFoundError(path)
        return read(path)

    (port := tmp_path / "port").symlink_to(pair.path)
    read = os.readlink
    monkeypatch.setattr(os, "readlink", unplugged)
    assert holders(str(port)) == []
