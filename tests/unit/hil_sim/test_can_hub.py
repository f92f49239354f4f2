"""The CAN hub with clients of other people, and faults that look like real ones."""

import socket
import time
from collections.abc import Callable, Iterator
from math import inf
from typing import Any

import can
import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import (
    Absent,
    BadCrc,
    BusOff,
    CanBus,
    DeviceState,
    Dribble,
    Duplicate,
    Echo,
    Frame,
    Garbage,
    Heal,
    Late,
    LogEntry,
    Mute,
    Replug,
    SimulationError,
    Truncate,
    Unmute,
    Unplug,
    events,
    frames,
)

pytestmark = pytest.mark.virtual_time


class Parrot:
    """A device that answers every frame ``100#data`` with ``200+id#data``."""

    def __init__(self, device_id: int) -> None:
        self.device_id, self.joint, self.due = device_id, f"parrot{device_id}", inf
        self.heard: list[Frame] = []
        self.done: list[Any] = []
        self.send: Callable[[Frame, float], None]
        self.emit: Callable[[LogEntry], None]

    def hear(self, frame: Frame, t: float) -> None:
        self.heard.append(frame)
        if frame.can_id == 0x100:
            self.send(Frame(0x200 + self.device_id, frame.data), t)

    def advance(self, t: float) -> None:
        raise AssertionError("it has nothing to do by itself")

    def do(self, command: Any, t: float) -> None:
        self.done.append(command)

    def heal(self, t: float) -> None:
        self.done.clear()

    def state(self, t: float) -> DeviceState:
        return DeviceState(
            device_id=self.device_id,
            joint=self.joint,
            model="parrot",
            position_counts=0,
            position_rad=0.0,
            velocity_rad_s=0.0,
            goal_counts=0,
            torque=False,
            moving=False,
            operating_mode=0,
            hardware_error=0,
            watchdog=0,
            absent=False,
        )


class Labelled(CanBus):
    @staticmethod
    def label(frame: Frame) -> tuple[str, int | None]:
        return ("ask", None) if frame.can_id == 0x100 else ("answer", frame.can_id & 0xF)


@pytest.fixture
def make_can() -> Iterator[Callable[..., CanBus]]:
    opened: list[CanBus] = []

    def make(*ids: int, paced: bool = False, **options: Any) -> CanBus:
        bus = Labelled([Parrot(i) for i in ids], paced=paced, **options)
        opened.append(bus.open())
        return bus

    yield make
    for bus in opened:
        bus.close()


def tcp_port(bus: CanBus) -> int:
    return int(bus.port.split(":")[2].partition("/")[0])


@pytest.fixture
def connect() -> Iterator[Callable[..., can.BusABC]]:
    """python-can, unmodified, as a client."""
    opened: list[can.BusABC] = []

    def connect_(bus: CanBus) -> can.BusABC:
        client = can.Bus(
            interface="socketcand", channel=bus.channel, host="127.0.0.1", port=tcp_port(bus), tcp_tune=True
        )
        opened.append(client)
        return client

    yield connect_
    for client in opened:
        client.shutdown()


def take(client: can.BusABC, count: int) -> list[can.Message]:
    got: list[can.Message] = []
    wait_until(lambda: got.append(m) if (m := client.recv(0.05)) else len(got) >= count, f"{count} frames")
    return got


def message(can_id: int, data: bytes = b"", **options: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=can_id > 0x7FF, **options)


# the hub, with other people's clients


def test_several_clients_see_each_others_frames_but_not_their_own(make_can: Any, connect: Any) -> None:
    bus = make_can()
    a, b, c = connect(bus), connect(bus), connect(bus)
    a.send(message(0x123, b"\x01\x02"))
    a.send(message(0x1ABCDEF0, bytes(range(8))))
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in take(c, 2)] == [
        (0x123, False, b"\x01\x02"),
        (0x1ABCDEF0, True, bytes(range(8))),
    ]
    b.send(message(0x80))
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in take(c, 1)] == [(0x80, False, b"")]
    assert [m.arbitration_id for m in take(a, 1)] == [0x80]
    assert [m.arbitration_id for m in take(b, 2)] == [0x123, 0x1ABCDEF0]
    assert [(e.source, e.can_id, e.data.hex()) for e in frames(bus.log.entries, direction="in")] == [
        ("client1", 0x123, "0102"),
        ("client1", 0x1ABCDEF0, "0001020304050607"),
        ("client2", 0x80, ""),
    ]


def test_devices_answer_and_the_log_says_who_sent_what(make_can: Any, connect: Any) -> None:
    bus = make_can(1, 2)
    client = connect(bus)
    client.send(message(0x100, b"\xaa"))
    assert [(m.arbitration_id, bytes(m.data)) for m in take(client, 2)] == [(0x201, b"\xaa"), (0x202, b"\xaa")]
    log = bus.log.entries
    assert [(e.name, e.source, e.direction, e.can_id, e.device_id) for e in frames(log)] == [
        ("ask", "client1", "in", 0x100, None),
        ("answer", "parrot1", "out", 0x201, 1),
        ("answer", "parrot2", "out", 0x202, 2),
    ]
    assert frames(log, device_id=2) == frames(log, can_id=0x202) == frames(log, source="parrot2") == frames(log)[2:]
    assert frames(log, "ask", direction="out") == []
    assert frames(log, since=time.monotonic()) == []


def test_times_in_the_text_are_wall_clock_times_of_the_log(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    client = connect(bus)
    client.send(message(0x100))
    [answer] = take(client, 1)
    [entry] = frames(bus.log.entries, direction="out")
    offset = time.time() - time.monotonic()
    assert answer.timestamp - entry.t == pytest.approx(offset, abs=1.0)


def test_a_paced_bus_carries_no_more_than_its_bitrate(make_can: Any, connect: Any) -> None:
    bus = make_can(paced=True, bitrate=100_000)
    a, b = connect(bus), connect(bus)
    for k in range(100):
        a.send(message(0x100, bytes([k] * 8)))
    assert [m.data[0] for m in take(b, 100)] == list(range(100))
    ends = [e.t for e in frames(bus.log.entries)]
    bits = sum(Frame(0x100, bytes([k] * 8)).bits for k in range(1, 100))
    assert ends[-1] - ends[0] >= bits / 1e5 * 0.999


def test_its_load_is_the_share_of_time_the_wire_is_held(make_can: Any, connect: Any) -> None:
    bus = make_can(1, paced=True, bitrate=100_000)
    client = connect(bus)
    before = bus.load()[0]
    client.send(message(0x100))
    take(client, 1)
    assert bus.load()[0] - before == pytest.approx((Frame(0x100).bits + Frame(0x201).bits) / 1e5)


def test_a_client_may_speak_byte_by_byte(make_can: Any) -> None:
    bus = make_can(1)
    with socket.create_connection(("127.0.0.1", tcp_port(bus)), timeout=10) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        assert line.recv(256) == b"< hi >"
        for words in (b"< open can0 >", b"< rawmode >"):
            line.sendall(words)
            assert line.recv(256) == b"< ok >"
        for byte in b"< send 100 2 a b >":
            line.sendall(bytes([byte]))
        heard = line.recv(256)
        assert heard.startswith(b"< frame 201 ")
        assert heard.endswith(b" 0A0B >")


def test_a_wrong_channel_or_word_is_refused(make_can: Any) -> None:
    bus = make_can(1)
    with socket.create_connection(("127.0.0.1", tcp_port(bus)), timeout=10) as line:
        assert line.recv(256) == b"< hi >"
        line.sendall(b"< open can7 >")
        assert line.recv(256) == b"< error could not open bus can7 >"
        line.sendall(b"< rawmode >")
        assert line.recv(256) == b"< error unknown command >"
        line.sendall(b"< open can0 >")
        assert line.recv(256) == b"< ok >"
        line.sendall(b"< rawmode >")
        assert line.recv(256) == b"< ok >"
        line.sendall(b"< send 999 1 1 >")
        wait_until(lambda: len(events(bus.log.entries, "misunderstood")) == 2, "the complaint")
    assert [e.detail for e in events(bus.log.entries, "misunderstood")] == ["rawmode", "not a frame: 999 1 1"]


@pytest.mark.realtime
def test_a_client_that_does_not_read_delays_no_other(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    awake = connect(bus)
    with socket.socket() as asleep:
        asleep.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        asleep.settimeout(10)
        asleep.connect(("127.0.0.1", tcp_port(bus)))
        for words, answer in ((b"", b"< hi >"), (b"< open can0 >", b"< ok >"), (b"< rawmode >", b"< ok >")):
            asleep.sendall(words)
            assert asleep.recv(256) == answer
        rounds = 0
        while not events(bus.log.entries, "overrun"):
            for _ in range(250):
                awake.send(message(0x100, bytes(8)))
            take(awake, 250)
            rounds += 1
            assert rounds < 100
        awake.send(message(0x100))
        assert take(awake, 1)[0].arbitration_id == 0x201


# faults

ASK = message(0x100, b"\x01\x02\x03\x04\x05")
WHOLE = b"\x01\x02\x03\x04\x05"


@pytest.mark.parametrize(
    ("fault", "answers"),
    [
        (Mute(ids=(1,), count=1), [(0x202, WHOLE)]),
        (Mute(count=1), [(0x202, WHOLE)]),
        (Truncate(ids=(2,), missing=2), [(0x201, WHOLE), (0x202, b"\x01\x02\x03")]),
        (Garbage(ids=(1,), hex="ff00"), [(0x201, b"\xff\x00"), (0x201, WHOLE), (0x202, WHOLE)]),
        (Duplicate(ids=(1,)), [(0x201, WHOLE), (0x201, WHOLE), (0x202, WHOLE)]),
        (Late(ids=(1,), s=0.05), [(0x202, WHOLE), (0x201, WHOLE)]),
        (Absent(ids=(1,)), [(0x202, WHOLE)]),
        (BusOff(ids=(2,)), [(0x201, WHOLE)]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_fault_does_what_it_says(make_can: Any, connect: Any, fault: Any, answers: list[Any]) -> None:
    bus = make_can(1, 2)
    client = connect(bus)
    bus.do(fault)
    client.send(ASK)
    assert sorted((m.arbitration_id, bytes(m.data)) for m in take(client, len(answers))) == sorted(answers)
    assert [e.can_id for e in frames(bus.log.entries, direction="out")] == [can_id for can_id, _ in answers]
    bus.do(Heal())
    client.send(ASK)
    assert [m.arbitration_id for m in take(client, 2)] == [0x201, 0x202]


def test_a_clients_frame_only_suffers_from_a_fault_that_names_it(make_can: Any, connect: Any) -> None:
    bus = make_can(1, 2)
    client, other = connect(bus), connect(bus)
    bus.do(Mute(ids=(1,)))
    client.send(message(0x201, b"\x01"))
    assert take(other, 1)[0].arbitration_id == 0x201
    bus.do(Mute(ids=(1,), instruction="answer"))
    client.send(message(0x201, b"\x02"))
    client.send(message(0x202, b"\x03"))
    assert take(other, 1)[0].arbitration_id == 0x202
    bus.do(Unmute())
    client.send(message(0x201, b"\x04"))
    assert bytes(take(other, 1)[0].data) == b"\x04"


def test_a_frame_that_concerns_no_device_can_be_lost_too(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    client = connect(bus)
    bus.do(Mute(instruction="ask", count=2))
    for k in range(3):
        client.send(message(0x100, bytes([k])))
    assert bytes(take(client, 1)[0].data) == b"\x02"


def test_a_corrupted_frame_is_an_error_frame_and_comes_again(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    client = connect(bus)
    bus.do(BadCrc(ids=(1,), count=2))
    client.send(ASK)
    got = take(client, 3)
    assert [m.is_error_frame for m in got] == [True, True, False]
    assert bytes(got[-1].data) == WHOLE
    assert len(events(bus.log.entries, "destroyed", device_id=1)) == 2
    assert len(frames(bus.log.entries, device_id=1)) == 1


def test_a_device_whose_every_frame_is_destroyed_goes_bus_off(make_can: Any, connect: Any) -> None:
    bus = make_can(1, 2)
    client = connect(bus)
    bus.do(BadCrc(ids=(1,)))
    client.send(ASK)
    wait_until(lambda: events(bus.log.entries, "bus_off", device_id=1), "bus-off")
    assert len(events(bus.log.entries, "destroyed", device_id=1)) == 32
    bus.do(Heal())
    take(client, 33)
    client.send(ASK)
    assert [m.arbitration_id for m in take(client, 2)] == [0x201, 0x202]


def test_an_adapter_that_is_bus_off_says_so_and_carries_nothing(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    client = connect(bus)
    bus.do(BusOff())
    [reported] = take(client, 1)
    assert (reported.is_error_frame, reported.arbitration_id) == (True, 0x40)
    client.send(ASK)
    assert bus.devices[0].heard == []
    bus.do(BusOff(on=False))
    [reported] = take(client, 1)
    assert (reported.is_error_frame, reported.arbitration_id) == (True, 0x100)
    client.send(message(0x100, b"\x07"))
    assert bytes(take(client, 1)[0].data) == b"\x07"
    assert [f.data for f in bus.devices[0].heard] == [b"\x07"]


def test_an_adapter_that_echoes_sends_clients_their_own_frames(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    client = connect(bus)
    bus.do(Echo())
    client.send(ASK)
    assert [m.arbitration_id for m in take(client, 2)] == [0x100, 0x201]


def test_an_adapter_can_be_unplugged_and_comes_back_under_the_same_port(make_can: Any, connect: Any) -> None:
    bus = make_can(1)
    port = bus.port
    with socket.create_connection(("127.0.0.1", tcp_port(bus)), timeout=10) as line:
        assert line.recv(256) == b"< hi >"
        bus.do(Unplug())
        assert line.recv(256) == b""
    assert not bus.state().plugged
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", tcp_port(bus)), timeout=10)
    bus.do(Replug())
    assert (bus.port, bus.state().plugged) == (port, True)
    client = connect(bus)
    client.send(ASK)
    assert len(take(client, 1)) == 1
    assert [e.name for e in events(bus.log.entries) if e.name.endswith("plugged")] == ["unplugged", "plugged"]


def test_orders_for_one_device_reach_it_and_unknown_ones_are_refused(make_can: Any) -> None:
    bus = make_can(1, 2)
    with pytest.raises(SimulationError, match=r"bus bus has no device \[9\]; it has \[1, 2\]"):
        bus.do(Mute(ids=(9,)))
    bus.do(BusOff(ids=(2,)))
    assert [device.done for device in bus.devices] == [[], [BusOff(ids=(2,))]]
    bus.do(Absent(ids=(1,)))
    assert [device.absent for device in bus.state().devices] == [True, False]
    with pytest.raises(SimulationError, match="a frame comes whole"):
        bus.do(Dribble(s=0.1))


def test_the_port_it_gives_is_text_and_it_closes_once(make_can: Any) -> None:
    bus = make_can(channel="can3")
    assert bus.port == f"socketcand:127.0.0.1:{tcp_port(bus)}/can3"
    assert bus.state().port == bus.port
    bus.close()
    bus.close()
    with pytest.raises(SimulationError, match="is closed"):
        bus.state()
    with pytest.raises(SimulationError, match="make a new one"):
        bus.open()
