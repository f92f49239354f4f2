"""The serial line as pyserial sees it, and nothing left behind."""

import os
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from tests.support.waiting import wait_until
from trade_hil_sim import ByteLog, SerialLine, SimulationError, received, sent

pytestmark = pytest.mark.realtime


class Parrot:
    """Answers what it hears; wakes at a set time."""

    def __init__(self) -> None:
        self.line: SerialLine | None = None
        self.heard = b""
        self.bauds: list[int | None] = []
        self.wake_at: float | None = None
        self.woken = threading.Event()
        self.answering: Callable[[SerialLine, bytes], None] = lambda line, data: line.send(data)

    def received(self, data: bytes, t: float) -> None:
        assert self.line is not None
        self.heard += data
        self.bauds.append(self.line.client_baud)
        self.answering(self.line, data)

    def wake_in_s(self) -> float | None:
        return None if self.wake_at is None else self.wake_at - time.monotonic()

    def wake(self) -> None:
        if self.wake_at is not None and time.monotonic() >= self.wake_at:
            self.wake_at = None
            self.woken.set()


@pytest.fixture
def log() -> ByteLog:
    return ByteLog()


@pytest.fixture
def parrot() -> Parrot:
    return Parrot()


@pytest.fixture
def line(tmp_path: Path, parrot: Parrot, log: ByteLog) -> Iterator[SerialLine]:
    parrot.line = SerialLine(tmp_path / "tty", parrot, name="neck", log=log, paced=False)
    with parrot.line as line:
        yield line


@pytest.fixture
def port(line: SerialLine) -> Iterator[serial.Serial]:
    with serial.Serial(str(line.link), 1_000_000, timeout=10) as port:
        yield port


def test_all_byte_values_pass_unchanged_both_ways(port: serial.Serial, parrot: Parrot, log: ByteLog) -> None:
    everything = bytes(range(256))
    port.write(everything)
    assert port.read(256) == everything
    assert received(log.entries) == sent(log.entries) == everything


def test_what_is_sent_before_a_client_opens_is_not_echoed(line: SerialLine, parrot: Parrot) -> None:
    fd = os.open(line.link, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(fd, b"\x03\r\n\x04")
        got = b""
        while len(got) < 4:
            got += os.read(fd, 10)
        assert got == parrot.heard == b"\x03\r\n\x04"
    finally:
        os.close(fd)


@pytest.mark.parametrize("baud", [9600, 57_600, 1_000_000, 4_000_000, 250_000, 4_500_000, 1_234_567])
def test_it_sees_the_clients_baud_rate(line: SerialLine, parrot: Parrot, baud: int) -> None:
    with serial.Serial(str(line.link), baud, timeout=10) as port:
        port.write(b"x")
        assert port.read(1) == b"x"
    assert parrot.bauds == [baud]


def test_unplugging_is_an_error_for_the_process_that_has_it_open(line: SerialLine, port: serial.Serial) -> None:
    line.unplug()
    assert not line.plugged
    assert not line.link.is_symlink()
    with pytest.raises(serial.SerialException):
        port.read(1)
    with pytest.raises(serial.SerialException):
        port.write(b"x")
    with pytest.raises(termios.error):
        port.reset_input_buffer()
    with pytest.raises(serial.SerialException):
        serial.Serial(str(line.link))


def test_a_blocked_read_is_woken_by_unplugging(line: SerialLine, port: serial.Serial) -> None:
    failed: list[BaseException] = []

    def read() -> None:
        try:
            port.read(1)
        except serial.SerialException as gone:
            failed.append(gone)

    reader = threading.Thread(target=read)
    reader.start()
    line.unplug()
    reader.join(9)  # the read's own timeout is 10
    assert failed


def test_after_replugging_the_same_name_works_and_the_old_port_never_does(
    line: SerialLine, port: serial.Serial
) -> None:
    line.unplug()
    line.unplug()
    line.replug()
    line.replug()
    with serial.Serial(str(line.link), 1_000_000, timeout=10) as again:
        again.write(b"back")
        assert again.read(4) == b"back"
    with pytest.raises(serial.SerialException):
        port.write(b"x")


def test_an_answer_pending_at_unplugging_is_lost(line: SerialLine, port: serial.Serial, parrot: Parrot) -> None:
    parrot.answering = lambda line, data: line.send(data, late_s=30.0)
    port.write(b"x")
    wait_until(lambda: parrot.heard, "it was heard")
    line.unplug()
    line.replug()
    parrot.answering = lambda line, data: line.send(data)
    with serial.Serial(str(line.link), 1_000_000, timeout=10) as again:
        again.write(b"y")
        assert again.read(1) == b"y"


def test_a_client_that_does_not_read_loses_bytes_and_stops_no_other(
    line: SerialLine, port: serial.Serial, parrot: Parrot, log: ByteLog
) -> None:
    parrot.answering = lambda line, data: line.send(data * 50)
    for _ in range(10):
        port.write(bytes(1000))
    wait_until(lambda: len(parrot.heard) == 10_000)
    wait_until(lambda: any(e.name == "overrun" for e in log.entries), "the overrun")


def test_a_peer_is_woken_when_it_asked_to_be(line: SerialLine, parrot: Parrot) -> None:
    parrot.wake_at = time.monotonic() + 0.05
    line.nudge()
    assert parrot.woken.wait(10)


def test_a_late_answer_lets_others_pass(port: serial.Serial, parrot: Parrot) -> None:
    parrot.answering = lambda line, data: line.send(data, late_s=0.2 if data == b"a" else 0.0)
    port.write(b"a")
    wait_until(lambda: parrot.heard == b"a", "the first was heard")
    port.write(b"b")
    assert port.read(2) == b"ba"


def test_pacing_takes_ten_bits_a_byte_in_both_directions_and_the_return_delay(
    tmp_path: Path, parrot: Parrot, log: ByteLog
) -> None:
    parrot.line = SerialLine(tmp_path / "slow", parrot, log=log, paced=True)
    parrot.answering = lambda line, data: line.send(data, after_s=0.002)
    with parrot.line as line, serial.Serial(str(line.link), 57_600, timeout=10) as port:
        port.write(bytes(100))
        assert len(port.read(100)) == 100
    heard, said = (next(e for e in log.entries if e.kind == kind) for kind in ("received", "sent"))
    assert said.t - heard.t >= 200 * 10 / 57_600 + 0.002 - 1e-4


def test_closing_twice_is_once_and_a_closed_line_says_so(tmp_path: Path, parrot: Parrot) -> None:
    line = SerialLine(tmp_path / "tty", parrot).open()
    assert line.link.is_symlink()
    line.close()
    line.close()
    assert not line.link.is_symlink()
    with pytest.raises(SimulationError, match="closed"):
        line.replug()
    with pytest.raises(SimulationError, match="was"):
        line.open()


def test_a_line_that_was_never_opened_closes_without_an_error(tmp_path: Path, parrot: Parrot) -> None:
    SerialLine(tmp_path / "tty", parrot).close()


def test_a_link_left_by_a_killed_process_is_replaced(tmp_path: Path, parrot: Parrot) -> None:
    (tmp_path / "tty").symlink_to("/dev/pts/99999")
    parrot.line = SerialLine(tmp_path / "tty", parrot, paced=False)
    with parrot.line, serial.Serial(str(tmp_path / "tty"), timeout=10) as port:
        port.write(b"x")
        assert port.read(1) == b"x"
