"""What is pure about a CAN bus and a drive on it: load, error frames, ports as text, states, frames. And the port."""

import itertools
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import can
import pytest

from trade.errors import ConfigurationError
from trade_drivers.bus.can import CanPort, ErrorState, Frame, LoadMeter, error_state, frame_bits, split_port
from trade_drivers.joints import PortLost
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._table import State, command_towards_enabled, state_of
from trade_hil_sim import BusOff, CanBus, Replug, Unplug, frames

_numbers = itertools.count()


@pytest.fixture
def channel() -> str:
    return f"test_can_{next(_numbers)}"


@pytest.mark.parametrize(("size", "bits"), [(0, 55), (8, 135)])
def test_a_frame_takes_at_most_the_bits_of_the_standard(size: int, bits: int) -> None:
    assert frame_bits(size) == bits


def test_the_load_is_the_share_of_the_bit_rate_in_the_last_second() -> None:
    meter = LoadMeter(1_000_000, 0)
    for number in range(1, 5001):
        meter.add(frame_bits(8), number * 200_000)
    assert meter.load == pytest.approx(5000 * 135 / 1_000_000)


@pytest.mark.parametrize(
    ("frame_id", "data", "state"),
    [
        (0x040, bytes(8), ErrorState.BUS_OFF),
        (0x100, bytes(8), ErrorState.ACTIVE),
        (0x004, bytes((0, 0x20)), ErrorState.PASSIVE),
        (0x004, bytes((0, 0x10)), ErrorState.PASSIVE),
        (0x004, bytes((0, 0x04)), ErrorState.WARNING),
        (0x004, bytes((0, 0x40)), ErrorState.ACTIVE),
        (0x004, bytes(1), None),
        (0x088, bytes(8), None),
    ],
    ids=str,
)
def test_an_error_frame_says_how_the_controller_is(frame_id: int, data: bytes, state: ErrorState | None) -> None:
    assert error_state(frame_id, data) is state


def test_a_port_is_an_interface_and_a_channel() -> None:
    assert split_port("socketcand:127.0.0.1:29536/can0", "x") == ("socketcand", "127.0.0.1:29536/can0")
    for text in ("can0", ":can0", "socketcan:", ""):
        with pytest.raises(ConfigurationError, match="not a CAN bus; write INTERFACE:CHANNEL"):
            split_port(text, "legs.toml: bus.legs")


@pytest.mark.parametrize("channel_text", ["can0", "127.0.0.1/", "/can0", "127.0.0.1:x/can0"])
def test_a_server_without_host_and_channel_is_refused(channel_text: str) -> None:
    with pytest.raises(ConfigurationError, match="write HOST:PORT/CHANNEL"):
        CanPort(f"socketcand:{channel_text}", 1_000_000, "legs.toml: bus.legs").open()


def test_an_unknown_interface_is_named_with_its_key() -> None:
    with pytest.raises(ConfigurationError, match=r"legs\.toml: bus\.legs\.interface: nonsense:can0"):
        CanPort("nonsense:can0", 1_000_000, "legs.toml: bus.legs").open()


def test_a_port_that_is_not_open_is_lost() -> None:
    port = CanPort("virtual:nowhere", 1_000_000)
    with pytest.raises(PortLost):
        port.send(0x123, b"")
    with pytest.raises(PortLost):
        port.receive(0)
    port.close()


def test_frames_are_sent_and_received_and_frames_of_other_kinds_are_ignored(channel: str) -> None:
    port = CanPort(f"virtual:{channel}", 1_000_000)
    port.open()
    with can.Bus(interface="virtual", channel=channel) as peer:
        port.send(0x123, b"ab")
        heard = peer.recv(5)
        assert heard is not None
        assert (heard.arbitration_id, bytes(heard.data), heard.is_extended_id) == (0x123, b"ab", False)
        peer.send(can.Message(arbitration_id=0x123, is_remote_frame=True, is_extended_id=False))
        peer.send(can.Message(arbitration_id=0x123, data=b"x", is_extended_id=True))
        peer.send(can.Message(arbitration_id=0x124, data=b"c", is_extended_id=False))
        found = [port.receive(5) for _ in range(3)]
    assert found[:2] == [None, None]
    assert found[2] == (0x124, b"c")
    port.close()
    port.close()


def test_a_bus_off_is_a_loss_and_what_comes_before_it_is_only_noted(channel: str) -> None:
    port = CanPort(f"virtual:{channel}", 1_000_000)
    port.open()
    with can.Bus(interface="virtual", channel=channel) as peer:
        peer.send(can.Message(arbitration_id=0x004, data=bytes((0, 0x20)), is_error_frame=True))
        assert port.receive(5) is None
        assert (port.state, port.errors) == (ErrorState.PASSIVE, 1)
        peer.send(can.Message(arbitration_id=0x040, data=bytes(8), is_error_frame=True))
        with pytest.raises(PortLost, match="bus-off"):
            port.receive(5)
        port.open()
        assert port.state is ErrorState.BUS_OFF  # that it could be opened does not say that it is over
        peer.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert port.receive(5) == (0x123, b"")
    assert (port.state, port.errors, port.bus_offs) == (ErrorState.ACTIVE, 2, 1)
    port.close()


@pytest.fixture
def bus() -> Iterator[CanBus]:
    with CanBus(paced=False) as simulated:
        yield simulated


def elsewhere(bus: CanBus) -> str:
    """The bus as another host reaches it, which knows nothing of who has it on this one."""
    return bus.port.replace("127.0.0.1", "localhost")


@pytest.mark.realtime
def test_frames_pass_the_simulated_adapter_both_ways(bus: CanBus) -> None:
    here, there = CanPort(bus.port, 1_000_000), CanPort(elsewhere(bus), 1_000_000)
    here.open()
    there.open()
    here.send(0x080, b"")
    here.send(0x201, bytes(range(8)))
    assert [there.receive(5), there.receive(5)] == [(0x080, b""), (0x201, bytes(range(8)))]
    assert [entry.can_id for entry in frames(bus.log.entries)] == [0x080, 0x201]
    here.close()
    there.close()


@pytest.mark.realtime
def test_frames_for_a_server_go_out_in_one_write_and_in_order(bus: CanBus, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = CanPort(bus.port, 1_000_000), CanPort(elsewhere(bus), 1_000_000)
    here.open()
    there.open()
    server: Any = here._bus  # type: ignore[attr-defined]
    writes, write = list[str](), server._tcp_send
    monkeypatch.setattr(server, "_tcp_send", lambda text: (writes.append(text), write(text)))
    here.send_all([Frame(0x501, b"\1"), Frame(0x502, b"\2"), Frame(0x500, b"")])
    assert [there.receive(5) for _ in range(3)] == [(0x501, b"\1"), (0x502, b"\2"), (0x500, b"")]
    assert len(writes) == 1
    here.close()
    there.close()


@pytest.mark.realtime
def test_an_unplugged_adapter_is_a_loss_after_few_frames_and_opens_again(bus: CanBus) -> None:
    port = CanPort(bus.port, 1_000_000)
    port.open()
    bus.do(Unplug())
    with pytest.raises(PortLost):
        for _ in range(1000):
            port.send(0x080, b"")
            port.receive(0.001)
    with pytest.raises(PortLost):
        port.open()
    bus.do(Replug())
    port.open()
    port.send(0x080, b"")
    port.close()


@pytest.mark.realtime
def test_a_bus_off_of_the_adapter_is_a_loss(bus: CanBus) -> None:
    port = CanPort(bus.port, 1_000_000)
    port.open()
    bus.do(BusOff())
    with pytest.raises(PortLost, match="bus-off"):
        port.receive(5)
    port.close()


@pytest.mark.parametrize("greeting", [b"", b"220 mail\r\n"], ids=["silence", "another server"])
def test_a_server_that_does_not_greet_is_a_loss_and_not_a_hang(greeting: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = CanPort(f"socketcand:127.0.0.1:{server.getsockname()[1]}/can0", 1_000_000)

        def greet() -> None:
            peer, _ = server.accept()
            with peer, suppress(OSError):
                peer.sendall(greeting)
                peer.recv(1)

        host = threading.Thread(target=greet)
        host.start()
        with pytest.raises(PortLost):
            port.open()
        host.join()


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0240, State.SWITCH_ON_DISABLED),
        (0x0260, State.SWITCH_ON_DISABLED),
        (0x0221, State.READY),
        (0x0233, State.SWITCHED_ON),
        (0x1637, State.ENABLED),
        (0x0217, State.QUICK_STOP),
        (0x020F, State.FAULT_REACTION),
        (0x021F, State.FAULT_REACTION),
        (0x0208, State.FAULT),
        (0x0228, State.FAULT),
        (0x0001, None),
    ],
    ids=lambda value: f"{value:04X}" if isinstance(value, int) else str(value),
)
def test_a_statusword_gives_the_state_whatever_its_other_bits(statusword: int, state: State | None) -> None:
    assert state_of(statusword) is state


def test_the_enabling_sequence_ends_halted_and_never_passes_a_fault() -> None:
    way = {state: command_towards_enabled(state) for state in (*State, None)}
    assert (way[State.SWITCH_ON_DISABLED], way[State.READY]) == (0x06, 0x07)
    assert {way[State.SWITCHED_ON], way[State.QUICK_STOP], way[State.ENABLED]} == {0x10F}
    assert all(way[state] is None for state in (State.NOT_READY, State.FAULT, State.FAULT_REACTION, None))
    assert table.GO & table.HALT == 0


@pytest.mark.parametrize(
    "pdo",
    [table.STATUS, table.MOTION, table.COMMAND, table.PROFILE, table.BRAKING],
    ids=lambda pdo: f"{pdo.communication:04X}h",
)
def test_a_frame_is_laid_out_as_it_is_mapped_and_fits(pdo: table.Pdo) -> None:
    assert pdo.layout.size == sum(entry.size for entry in pdo.entries) <= 8
    kinds = {"u1": "B", "u2": "H", "u4": "I", "i1": "b", "i2": "h", "i4": "i"}
    assert pdo.layout.format == "<" + "".join(kinds[entry.kind] for entry in pdo.entries)
    assert pdo.mapping()[0] >> 16 == pdo.entries[0].index


def test_numbers_of_the_dictionary_are_little_endian_and_signed_where_they_are() -> None:
    assert table.POSITION.decode(struct.pack("<i", -7)) == -7
    assert table.STATUSWORD.decode(bytes((0x37, 0x12, 0, 0))) == 0x1237
    assert table.MODE.encode(-1) == b"\xff"
    with pytest.raises(OverflowError):
        table.CONTROLWORD.encode(-1)
