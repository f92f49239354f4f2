"""The serial port that the drivers of all vendors share, on a pty."""

import os
import pty
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from trade.errors import ConfigurationError, DeadlineExceeded
from trade_drivers.bus._jobs import PortLost
from trade_drivers.bus._serial_port import LONGEST_WAIT_S, SerialLine, SerialWire
from trade_drivers.vendors.dynamixel._wire import Wire as ServoWire
from trade_drivers.vendors.robotiq._wire import Wire as GripperWire

pytestmark = pytest.mark.virtual_time

WIRES = pytest.mark.parametrize("kind", [ServoWire, GripperWire], ids=["dynamixel", "robotiq"])


class Pair:
    """A pty: the port a driver opens, and the other end."""

    def __init__(self) -> None:
        self.far, self._near = pty.openpty()
        self.path = os.ttyname(self._near)

    def unplug(self) -> None:
        for end in (self.far, self._near):
            if end >= 0:
                os.close(end)
        self.far = self._near = -1


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.unplug()


def use(wire: SerialWire) -> None:
    if isinstance(wire, GripperWire):
        wire.probe(9)
    else:
        assert isinstance(wire, ServoWire)
        wire.ping(1)


@WIRES
def test_a_port_belongs_to_one_driver(kind: type[SerialWire], pair: Pair) -> None:
    first, second = kind(pair.path, 115_200), kind(pair.path, 115_200, "robot.toml: bus.hand")
    first.open()
    with pytest.raises(ConfigurationError, match=r"bus\.hand\.port.*another driver owns this port"):
        second.open()
    first.close()
    second.open()
    second.close()


@pytest.mark.realtime
@WIRES
def test_what_is_no_serial_port_is_refused_and_what_is_absent_may_come(kind: type[SerialWire], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file"):
        with pytest.raises(ConfigurationError, match="is not a serial port"):
            kind(str(path), 115_200).open()
    with pytest.raises(PortLost, match="there is no such device"):
        kind(str(tmp_path / "absent"), 115_200).open()


@WIRES
def test_a_port_that_is_closed_or_unplugged_is_lost(kind: type[SerialWire], pair: Pair) -> None:
    wire = kind(pair.path, 115_200)
    with pytest.raises(PortLost, match="it is not open"):
        use(wire)
    wire.open()
    pair.unplug()
    with pytest.raises(PortLost):
        use(wire)
    wire.close()
    wire.close()


def test_bytes_that_the_gate_blocks_are_never_sent_and_its_error_is_not_one_of_the_port(pair: Pair) -> None:
    def late() -> NoReturn:
        raise DeadlineExceeded(service="move_to", deadline_s=0.1)  # a TimeoutError, so an OSError

    wire = ServoWire(pair.path, 115_200)
    wire.open()
    os.set_blocking(pair.far, False)
    with pytest.raises(DeadlineExceeded):
        wire.sync_write(64, {1: b"\1"}, late)
    with pytest.raises(BlockingIOError):
        os.read(pair.far, 1)
    wire.sync_write(64, {1: b"\1"})  # the gate was for that one exchange
    assert os.read(pair.far, 64)
    wire.close()


def test_bytes_are_waited_for_until_they_come_or_the_answer_is_overdue(pair: Pair) -> None:
    line = SerialLine(pair.path, 9600)
    line.open()
    os.write(pair.far, b"old")
    assert line.more(LONGEST_WAIT_S)
    line.flush()
    assert not line.received
    line.write(b"?")
    line.expect(10_000)  # seconds on the wire, but no exchange waits that long
    assert not line.more()
    os.write(pair.far, b"late")
    assert not line.more(), "an overdue answer is no answer"
    assert line.more(LONGEST_WAIT_S)
    assert bytes(line.received) == b"late"
    line.close()


def test_an_answer_that_came_in_time_is_read_by_a_driver_that_was_held_up(pair: Pair) -> None:
    line = SerialLine(pair.path, 1_000_000)
    line.open()
    line.write(b"?")
    line.expect(8)
    os.write(pair.far, b"answer")
    time.sleep(2 * LONGEST_WAIT_S)  # another program had the processor
    assert line.more()
    assert bytes(line.received) == b"answer"
    os.write(pair.far, b"chatter without an end")
    assert not line.more()
    line.close()


@pytest.mark.parametrize("wait", [True, False], ids=["waits", "held up"])
def test_silence_ends_at_the_timeout(pair: Pair, wait: bool) -> None:
    line = SerialLine(pair.path, 1_000_000)
    line.open()
    line.write(b"?")
    line.expect(8)
    if not wait:
        time.sleep(2 * LONGEST_WAIT_S)
    assert not line.more()
    line.close()
