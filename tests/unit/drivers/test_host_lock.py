"""Of what is driven from a host there is one driver, in whatever process it is."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from itertools import count

import pytest

from trade.errors import ConfigurationError
from trade_drivers.bus._host_lock import HostLock, Taken
from trade_drivers.bus._serial_port import SerialLine
from trade_drivers.bus.can import CanPort

pytestmark = pytest.mark.realtime

_numbers = count()
_HOLDER = """
import sys
from trade_drivers.bus._host_lock import HostLock
lock = HostLock(sys.argv[1], "robot.toml: bus.legs")
lock.take()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def what() -> str:
    return f"test_host_lock:{next(_numbers)}"


def test_the_second_process_learns_which_one_has_the_port_and_gets_it_when_that_is_killed(what: str) -> None:
    lock = HostLock(what, "head.toml: bus.neck")
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", _HOLDER, what], stdin=pipe, stdout=pipe, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(Taken, match=rf"^process {other.pid} \(robot.toml: bus.legs\)$"):
            lock.take()
        other.kill()
        other.wait()
        lock.take()
    lock.release()


def test_it_is_held_once_in_a_process_too_and_free_after_its_release(what: str) -> None:
    first, second, third = HostLock(what, "one"), HostLock(what, "another"), HostLock(f"{what}.", "elsewhere")
    first.take()
    first.take()
    with pytest.raises(Taken, match="one"):
        second.take()
    third.take()
    first.release()
    first.release()
    second.take()
    for lock in (second, third):
        lock.release()


def test_a_long_or_foreign_name_of_a_port_holder_is_shown_in_part(what: str) -> None:
    lock = HostLock(what, "ä" + 300 * "x" + "/rosie.toml: bus.legs")
    lock.take()
    with pytest.raises(Taken, match=r"xx/rosie.toml: bus.legs\)$"):
        HostLock(what, "").take()
    lock.release()


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The end of the adapter, and the device."""
    adapter, device = os.openpty()
    yield adapter, os.ttyname(device)
    os.close(adapter)
    os.close(device)


def sent(adapter: int) -> bytes:
    """What has come to the adapter since the last time."""
    data = b""
    while select.select([adapter], [], [], 0.05)[0]:
        data += os.read(adapter, 4096)
    return data


def test_a_serial_line_that_a_can_driver_has_is_not_scanned(line: tuple[int, str]) -> None:
    adapter, device = line
    port = CanPort(f"slcan:{device}", 1_000_000)
    port.open()
    assert sent(adapter)
    with pytest.raises(OSError, match="xclusive"):
        SerialLine(device, 1_000_000).open()
    assert not sent(adapter)
    port.close()
    alone = SerialLine(device, 1_000_000)
    alone.open()
    alone.close()


def test_a_serial_line_that_another_driver_has_is_no_can_bus(line: tuple[int, str]) -> None:
    adapter, device = line
    servos = SerialLine(device, 1_000_000)
    servos.open()
    with pytest.raises(ConfigurationError, match="another driver has this bus"):
        CanPort(f"slcan:{device}", 1_000_000).open()
    assert not sent(adapter)
    servos.close()
