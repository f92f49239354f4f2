"""A plain RTDE client, written here after the vendor's guide, on a simulated controller; and its faults."""

import socket
import struct
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import pairwise

import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import (
    Absent,
    Arm,
    BrownOut,
    Dribble,
    Freeze,
    HangUp,
    HardwareFault,
    Heal,
    Jam,
    Late,
    Local,
    Mute,
    Replug,
    SimulationError,
    Unplug,
    UrBus,
    events,
)
from trade_hil_sim.ur import HOME

PATIENCE_S = 30.0


@pytest.fixture
def controller() -> Iterator[UrBus]:
    with UrBus(Arm(unlock_s=0.1)) as bus:
        yield bus


class Rtde:
    """The protocol, as small as it gets."""

    def __init__(self, host: str) -> None:
        self.socket = socket.create_connection((host, 30004), PATIENCE_S)

    def send(self, kind: str, payload: bytes = b"") -> None:
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def receive(self) -> tuple[str, bytes]:
        size, kind = struct.unpack(">HB", self._exactly(3))
        return chr(kind), self._exactly(size - 3)

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        self.send(kind, payload)
        answer, data = self.receive()
        assert answer == kind
        return data

    def stream(self, names: str, hz: float = 500.0) -> bytes:
        """Have these fields sent; their types."""
        assert self.ask("V", b"\x00\x02") == b"\x01"
        types = self.ask("O", struct.pack(">d", hz) + names.encode())
        assert self.ask("S") == b"\x01"
        return types

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            if not more:
                raise ConnectionResetError
            data += more
        return data

    def close(self) -> None:
        self.socket.close()


def client(controller: UrBus) -> closing[Rtde]:
    return closing(Rtde(controller.port))


def times(rtde: Rtde, count: int) -> list[float]:
    return [struct.unpack_from(">d", rtde.receive()[1], 1)[0] for _ in range(count)]


def test_fields_come_in_the_order_and_types_that_were_asked_for(controller: UrBus) -> None:
    with client(controller) as rtde:
        assert rtde.stream("timestamp,actual_q,robot_mode,") == b"\x01DOUBLE,VECTOR6D,INT32"
        kind, data = rtde.receive()
        assert (kind, data[0], len(data)) == ("U", 1, 1 + 8 + 48 + 4)
        assert struct.unpack_from(">6d", data, 9) == pytest.approx(HOME)
        assert struct.unpack_from(">i", data, 57) == (7,)


def test_time_advances_by_the_period_asked_for(controller: UrBus) -> None:
    for hz in (500.0, 125.0):
        with client(controller) as rtde:
            rtde.stream("timestamp", hz)
            seen = times(rtde, 40)
            assert [round((b - a) * hz, 3) for a, b in pairwise(seen)] == [1.0] * 39


def test_what_does_not_exist_and_what_another_has_are_refused(controller: UrBus) -> None:
    with client(controller) as one, client(controller) as other:
        assert one.ask("O", struct.pack(">d", 125.0) + b"timestamp,nonsense") == b"\x00DOUBLE,NOT_FOUND"
        assert one.ask("S") == b"\x00"
        assert one.ask("I", b"input_int_register_5") == b"\x01INT32"
        assert other.ask("I", b"input_int_register_5") == b"\x00IN_USE"
    with client(controller) as third:
        wait_until(lambda: third.ask("I", b"input_int_register_5") == b"\x01INT32", "the register is free again")


def test_an_invalid_packet_ends_the_connection(controller: UrBus) -> None:
    with client(controller) as rtde:
        rtde.socket.sendall(b"\x00\x01V")
        with pytest.raises(ConnectionResetError):
            rtde.receive()
    assert events(controller.log.entries, "misunderstood")


@pytest.mark.parametrize(
    ("port", "sent"),
    [
        (29999, b"x" * 2_000_000),
        (30003, b"x" * 2_000_000),
        (30004, struct.pack(">HB", 65_010, ord("O")) + struct.pack(">d", 125.0) + b",".join([b"a"] * 32_500)),
    ],
    ids=["a line", "a program", "an answer longer than a packet"],
)
def test_an_endless_packet_ends_the_connection_and_nothing_else(controller: UrBus, port: int, sent: bytes) -> None:
    with closing(socket.create_connection((controller.port, port), PATIENCE_S)) as one:
        with suppress(ConnectionError):
            one.sendall(sent)
        with suppress(ConnectionError):
            while one.recv(4096):
                pass
    assert [entry.detail for entry in events(controller.log.entries, "misunderstood")] != []
    with client(controller) as rtde:
        assert rtde.stream("timestamp") == b"\x01DOUBLE"


def test_packets_are_understood_byte_by_byte_and_answers_may_come_so(controller: UrBus) -> None:
    controller.do(Dribble(s=0.001, count=1))
    with client(controller) as rtde:
        for byte in struct.pack(">HBH", 5, ord("V"), 2):
            rtde.socket.sendall(bytes([byte]))
        assert rtde.receive() == ("V", b"\x01")


def test_silence_keeps_the_connection_and_ends_with_the_fault(controller: UrBus) -> None:
    with client(controller) as rtde:
        rtde.stream("timestamp")
        before = times(rtde, 5)[-1]
        controller.do(Mute(instruction="data"))
        rtde.socket.settimeout(0.2)
        with pytest.raises(TimeoutError):
            times(rtde, 1000)
        rtde.socket.settimeout(PATIENCE_S)
        controller.do(Heal())
        assert times(rtde, 1)[0] - before > 0.1


def test_late_data_keeps_its_order(controller: UrBus) -> None:
    with client(controller) as rtde:
        rtde.stream("timestamp")
        controller.do(Late(s=0.05, instruction="data"))
        seen = times(rtde, 60)
        controller.do(Heal())  # what is on its way then comes before what is no longer late
        seen += times(rtde, 60)
        assert seen == sorted(seen)


def test_a_frozen_stream_continues_with_the_same_values(controller: UrBus) -> None:
    with client(controller) as rtde:
        rtde.stream("timestamp")
        controller.do(Freeze(tick=True))
        wait_until(lambda: len(set(times(rtde, 5))) == 1, "the clock is frozen")
        controller.do(Heal())
        wait_until(lambda: len(set(times(rtde, 5))) == 5, "the clock goes")


def test_an_absent_controller_accepts_and_never_answers(controller: UrBus) -> None:
    controller.do(Absent())
    with client(controller) as rtde:
        rtde.socket.settimeout(0.2)
        with pytest.raises(TimeoutError):
            rtde.ask("V", b"\x00\x02")


def test_unplugged_it_hangs_up_and_refuses_until_it_is_plugged_in(controller: UrBus) -> None:
    with client(controller) as rtde:
        rtde.stream("timestamp")
        controller.do(Unplug())
        with pytest.raises(ConnectionError):
            times(rtde, 1000)
    with pytest.raises(ConnectionRefusedError):
        Rtde(controller.port)
    controller.do(Replug())
    with client(controller) as again:
        again.stream("timestamp")
        assert times(again, 2)


def dashboard(controller: UrBus, *lines: str) -> list[str]:
    with (
        socket.create_connection((controller.port, 29999), PATIENCE_S) as connection,
        connection.makefile("rw") as file,
    ):
        assert file.readline() == "Connected: Universal Robots Dashboard Server\n"
        answers: list[str] = []
        for line in lines:
            file.write(line + "\n")
            file.flush()
            answers.append(file.readline().rstrip("\n"))
        return answers


@pytest.mark.slow
def test_after_a_reboot_the_arm_is_off_and_power_and_brakes_are_asked_for(controller: UrBus) -> None:
    controller.do(BrownOut())
    wait_until(lambda: controller.state().plugged, "it has booted")
    assert dashboard(controller, "robotmode") == ["Robotmode: POWER_OFF"]
    assert dashboard(controller, "power on") == ["Powering on"]
    wait_until(lambda: controller.state().arms[0].robot_mode == "IDLE", "it is powered")
    assert dashboard(controller, "brake release") == ["Brake releasing"]
    wait_until(lambda: controller.state().arms[0].robot_mode == "RUNNING", "its brakes are off")


def test_a_protective_stop_ends_a_program_and_is_unlocked_only_after_a_while(controller: UrBus) -> None:
    assert dashboard(controller, "play") == ["Starting program"]
    wait_until(lambda: controller.state().arms[0].moving, "its own program moves it")
    controller.do(HardwareFault(bits=3))
    refused, *_ = dashboard(controller, "unlock protective stop")
    assert refused.startswith("Cannot unlock")
    wait_until(lambda: not controller.state().arms[0].moving, "it has come to rest")
    wait_until(
        lambda: dashboard(controller, "unlock protective stop") == ["Protective stop releasing"], "it can be unlocked"
    )
    assert dashboard(controller, "safetymode", "running") == ["Safetymode: NORMAL", "Program running: false"]


def test_an_arm_that_is_held_fast_stops_by_itself(controller: UrBus) -> None:
    controller.do(Jam())
    dashboard(controller, "play")
    wait_until(lambda: controller.state().arms[0].safety_mode == "PROTECTIVE_STOP", "it notices")
    assert controller.state().arms[0].positions_rad == pytest.approx(HOME)


def test_without_remote_control_the_dashboard_only_answers_questions() -> None:
    with UrBus(remote=False) as controller:
        refused, mode = dashboard(controller, "power off", "robotmode")
        assert "not allowed" in refused
        assert mode == "Robotmode: RUNNING"


def test_in_local_control_it_takes_neither_orders_nor_programs(controller: UrBus) -> None:
    controller.do(Local())
    assert "not allowed" in dashboard(controller, "play")[0]
    with socket.create_connection((controller.port, 30003), PATIENCE_S) as script:
        script.sendall(b"def other():\nend\n")
        wait_until(lambda: dashboard(controller, "is in remote control") == ["false"], "it answers questions")
    assert not events(controller.log.entries, "upload")
    controller.do(Local(on=False))
    assert dashboard(controller, "play") == ["Starting program"]


def test_connections_of_one_kind_are_cut_and_made_again(controller: UrBus) -> None:
    with client(controller) as rtde, socket.create_connection((controller.port, 29999), PATIENCE_S) as other:
        rtde.stream("timestamp")
        controller.do(HangUp(kind="rtde"))
        with pytest.raises(ConnectionError):
            times(rtde, 1000)
        other.sendall(b"robotmode\n")
        assert other.makefile().readline().startswith("Connected")
    with client(controller) as again:
        again.stream("timestamp")


def test_a_safeguard_stop_pauses_a_program_which_then_continues_by_itself(controller: UrBus) -> None:
    dashboard(controller, "play")
    wait_until(lambda: controller.state().arms[0].moving, "its own program moves it")
    controller.do(HardwareFault(bits=5))
    wait_until(lambda: not controller.state().arms[0].moving, "it rests")
    assert dashboard(controller, "programState")[0].startswith("PAUSED")
    controller.do(HardwareFault(bits=1))
    wait_until(lambda: controller.state().arms[0].moving, "it moves again")
    controller.do(HardwareFault(bits=5))
    assert dashboard(controller, "stop") == ["Stopped"]
    controller.do(HardwareFault(bits=1))
    wait_until(lambda: controller.state().arms[0].safety_mode == "NORMAL", "it is over")
    assert events(controller.log.entries, "program_stopped")
    assert dashboard(controller, "running") == ["Program running: false"]


def test_after_an_emergency_stop_the_arm_is_without_power(controller: UrBus) -> None:
    controller.do(HardwareFault(bits=7))
    controller.do(HardwareFault(bits=1))
    assert dashboard(controller, "robotmode", "safetymode") == ["Robotmode: POWER_OFF", "Safetymode: NORMAL"]


def test_a_controller_of_the_older_series_is_slower_and_knows_less() -> None:
    with UrBus(Arm("UR10")) as controller, client(controller) as rtde:
        assert rtde.ask("v") == struct.pack(">4I", 3, 15, 8, 106_339)
        assert rtde.ask("O", struct.pack(">d", 125.0) + b"timestamp,ft_raw_wrench") == b"\x00DOUBLE,NOT_FOUND"
        rtde.stream("timestamp", 500.0)
        assert [round((b - a) * 125.0, 3) for a, b in pairwise(times(rtde, 20))] == [1.0] * 19
        assert "could not understand" in dashboard(controller, "is in remote control")[0]


def test_a_fault_that_an_arm_does_not_have_is_refused(controller: UrBus) -> None:
    with pytest.raises(SimulationError, match="no device"):
        controller.do(Mute(ids=(3,)))
    with pytest.raises(SimulationError, match="safety mode"):
        controller.do(HardwareFault(bits=32))
