"""The simulated Modbus line with other people's clients on it, unmodified."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import minimalmodbus
import pytest
import serial
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusIOException

import trade_hil_sim as sim
from tests.support.simulated_robots import HAND
from tests.support.waiting import wait_until
from tests.unit.hil_sim.conftest import FakeClock
from trade_drivers import parse
from trade_hil_sim import Gripper, RobotiqBus, SimulationError
from trade_hil_sim.robot._robot import buses_of, find_simulator
from trade_hil_sim.robotiq import frame

pytestmark = pytest.mark.realtime

COMMAND, STATUS = 0x03E8, 0x07D0
ANSWER_S = 0.5
"""Patience of the clients: simulator and client share two cores and one interpreter here."""


@pytest.fixture
def make_line(tmp_path: Path) -> Iterator[Callable[..., RobotiqBus]]:
    opened: list[RobotiqBus] = []

    def make(*grippers: Gripper, paced: bool = False, **options: Any) -> RobotiqBus:
        made = list(grippers) or [Gripper(9, t=options.get("clock", time.monotonic)())]
        opened.append(RobotiqBus(made, tmp_path / f"line{len(opened)}", paced=paced, **options).open())
        return opened[-1]

    yield make
    for line in opened:
        line.close()


@pytest.fixture
def line(make_line: Callable[..., RobotiqBus]) -> RobotiqBus:
    return make_line()


@pytest.fixture
def pymodbus(line: RobotiqBus) -> Iterator[ModbusSerialClient]:
    client = ModbusSerialClient(str(line.port), baudrate=115_200, timeout=ANSWER_S, retries=0)
    assert client.connect()
    yield client
    client.close()


@pytest.fixture
def minimal(line: RobotiqBus) -> Iterator[minimalmodbus.Instrument]:
    client = minimalmodbus.Instrument(str(line.port), 9)
    client.serial.baudrate = 115_200
    client.serial.timeout = ANSWER_S
    yield client
    client.serial.close()


@pytest.fixture
def port(line: RobotiqBus) -> Iterator[serial.Serial]:
    with serial.Serial(str(line.port), 115_200, timeout=ANSWER_S) as opened:
        yield opened


def truth(line: RobotiqBus) -> sim.GripperTruth:
    return line.state().grippers[0]


def test_pymodbus_activates_grips_and_releases(line: RobotiqBus, pymodbus: ModbusSerialClient) -> None:
    line.do(sim.Put(width_m=0.04))
    pymodbus.write_registers(COMMAND, [0x0100, 0, 0], device_id=9)
    wait_until(lambda: pymodbus.read_holding_registers(STATUS, count=1, device_id=9).registers == [0x3100])
    both = pymodbus.readwrite_registers(
        read_address=STATUS, read_count=3, write_address=COMMAND, values=[0x0900, 255, 0xFFFF], device_id=9
    )
    assert len(both.registers) == 3
    wait_until(lambda: pymodbus.read_input_registers(STATUS, count=1, device_id=9).registers == [0xB900])
    assert truth(line).holding
    pymodbus.write_register(COMMAND + 1, 0, device_id=9)
    wait_until(lambda: pymodbus.read_input_registers(STATUS, count=3, device_id=9).registers == [0xF900, 0, 0x0300])
    assert not truth(line).holding


def test_pymodbus_hears_nothing_of_a_bad_request_as_the_manual_says(pymodbus: ModbusSerialClient) -> None:
    with pytest.raises(ModbusIOException):
        pymodbus.read_holding_registers(0, count=1, device_id=9)
    with pytest.raises(ModbusIOException):
        pymodbus.read_coils(STATUS, count=1, device_id=9)


def test_pymodbus_hears_an_exception_of_a_gripper_that_has_them(make_line: Callable[..., RobotiqBus]) -> None:
    line = make_line(Gripper(9, t=time.monotonic(), exceptions=True))
    client = ModbusSerialClient(str(line.port), baudrate=115_200, timeout=ANSWER_S, retries=0)
    assert client.connect()
    try:
        assert client.read_holding_registers(0, count=1, device_id=9).exception_code == 2
        assert client.write_register(STATUS, 1, device_id=9).exception_code == 2
        assert client.read_input_registers(STATUS, count=9, device_id=9).exception_code == 2
    finally:
        client.close()


def test_minimalmodbus_activates_and_closes(line: RobotiqBus, minimal: minimalmodbus.Instrument) -> None:
    minimal.write_register(COMMAND, 0x0100, functioncode=6)
    wait_until(lambda: minimal.read_register(STATUS) == 0x3100)
    minimal.write_registers(COMMAND, [0x0900, 255, 0xFF00])
    wait_until(lambda: minimal.read_registers(STATUS, 3, functioncode=4) == [0xF900, 255, 0xE600])
    assert truth(line).width_m == pytest.approx(0)


def test_minimalmodbus_hears_nothing_of_another_id(minimal: minimalmodbus.Instrument) -> None:
    minimal.address = 8
    with pytest.raises(minimalmodbus.NoResponseError):
        minimal.read_register(STATUS)


@pytest.mark.parametrize("fault", [sim.BadCrc(count=1), sim.Truncate(count=1), sim.Garbage(count=1)], ids=repr)
def test_minimalmodbus_notices_a_bad_answer(
    line: RobotiqBus, minimal: minimalmodbus.Instrument, fault: sim.Command
) -> None:
    line.do(fault)
    with pytest.raises(minimalmodbus.InvalidResponseError):
        minimal.read_registers(STATUS, 3)
    assert len(minimal.read_registers(STATUS, 3)) == 3


def ask(port: serial.Serial, request: str, size: int) -> str:
    port.write(bytes.fromhex(request))
    return port.read(size).hex(" ", -2).upper()


def test_the_frames_of_the_manual_by_hand(line: RobotiqBus, port: serial.Serial) -> None:
    assert ask(port, "091003E80003060000000000007330", 8) == "0910 03E8 0003 0130"
    assert ask(port, "091003E800030601000000000072E1", 8) == "0910 03E8 0003 0130"
    wait_until(lambda: truth(line).activated)
    assert ask(port, "090407D00001300F", 7).replace(" ", "") == "09040231004D61"
    line.do(sim.Put(width_m=0.03))
    ask(port, "091003E8000306090000FFFFFF4229", 8)
    wait_until(lambda: truth(line).holding)
    assert ask(port, "090307D00003040E", 11).replace(" ", "").startswith("090306B90000FF")


def test_a_request_with_a_wrong_check_sum_is_not_obeyed(line: RobotiqBus, port: serial.Serial) -> None:
    assert ask(port, "091003E800030601000000000072E0", 1) == ""
    assert not sim.events(line.log.entries, "activating")
    assert [entry.name for entry in sim.instructions(line.log.entries)] == ["damaged"]


def test_a_broadcast_is_obeyed_and_not_answered(
    make_line: Callable[..., RobotiqBus],
) -> None:
    t = time.monotonic()
    line = make_line(Gripper(9, t=t), Gripper(10, t=t))
    with serial.Serial(str(line.port), 115_200, timeout=ANSWER_S) as port:
        port.write(frame(bytes.fromhex("00 06 03E8 0100")))
        wait_until(lambda: all(one.activated for one in line.state().grippers))
        assert port.in_waiting == 0


def test_at_another_baud_rate_nothing_is_heard(line: RobotiqBus) -> None:
    with serial.Serial(str(line.port), 9600, timeout=ANSWER_S) as port:
        assert ask(port, "090307D00003040E", 1) == ""
    assert not sim.instructions(line.log.entries)


def test_an_answer_takes_the_time_its_bytes_and_the_gap_before_it_take(make_line: Callable[..., RobotiqBus]) -> None:
    line = make_line(Gripper(9, t=time.monotonic(), baud=9600), paced=True)
    with serial.Serial(str(line.port), 9600, timeout=5) as port:
        assert len(bytes.fromhex("".join(ask(port, "090307D00003040E", 11).split()))) == 11
    [came] = [entry for entry in line.log.entries if entry.kind == "received"]
    [went] = [entry for entry in line.log.entries if entry.kind == "sent"]
    characters = (went.t - came.t) * 9600 / 10
    assert characters > 8 + 3.5 + 11 - 0.5


def test_the_log_says_what_could_move_and_what_could_not(make_line: Callable[..., RobotiqBus]) -> None:
    clock = FakeClock()
    line = make_line(clock=clock)
    with serial.Serial(str(line.port), 115_200, timeout=ANSWER_S) as port:
        for body, size in (
            ("09 06 03E8 0100", 8),
            ("09 06 03E9 00FF", 8),
            ("09 06 03E8 0900", 8),
            ("09 06 03E9 0010", 8),
            ("09 06 03E8 0100", 8),
            ("09 06 03E8 0000", 8),
            ("09 06 03E8 1000", 8),
            ("09 03 07D0 0001", 7),
        ):
            port.write(frame(bytes.fromhex(body)))
            assert len(port.read(size)) == size
    assert [entry.moves for entry in sim.instructions(line.log.entries)] == [
        *(True, False, True, True),
        *(False, False, True, False),
    ]
    assert len(sim.writes(line.log.entries, register="position_request")) == 2


def test_unplugging_takes_the_port_away_and_the_gripper_stays_as_it_was(
    line: RobotiqBus, pymodbus: ModbusSerialClient
) -> None:
    pymodbus.write_registers(COMMAND, [0x0100, 0, 0], device_id=9)
    wait_until(lambda: truth(line).activated)
    line.do(sim.Unplug())
    assert not line.port.exists()
    line.do(sim.Replug())
    assert line.port.exists()
    assert truth(line).activated


def test_another_device_in_its_place_refuses_its_registers(line: RobotiqBus, pymodbus: ModbusSerialClient) -> None:
    line.do(sim.WrongModel(number=0))
    for answer in (
        pymodbus.read_input_registers(STATUS, count=3, device_id=9),
        pymodbus.write_registers(COMMAND, [0x0100, 0, 0], device_id=9),
    ):
        assert (answer.isError(), answer.exception_code) == (True, 2)
    assert not sim.events(line.log.entries, "activating")
    line.do(sim.Heal())
    assert pymodbus.read_input_registers(STATUS, count=3, device_id=9).registers[0] == 0


def test_orders_that_are_none_for_a_gripper_are_refused(line: RobotiqBus) -> None:
    with pytest.raises(SimulationError, match="Place is nothing that happens to a 2F-85"):
        line.do(sim.Place(counts=12))
    with pytest.raises(SimulationError, match=r"no device \[3\]; it has \[9\]"):
        line.do(sim.Mute(ids=(3,)))


def test_a_robot_files_grippers_are_simulated_by_the_driver_they_name(tmp_path: Path) -> None:
    assert find_simulator("robotiq") is RobotiqBus
    [bus] = buses_of(parse(HAND, "hand.toml"), tmp_path)
    [gripper] = bus.state().grippers
    assert (gripper.gripper, gripper.device_id, gripper.activated) == ("left.hand", 9, False)
    assert gripper.width_m == pytest.approx(0.085)


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ('"2F-85"', '"2F-140"', "'2F-140' is not simulated; there is 2F-85"),
        ("115200", "1000000", "bus.hand.baud: 1000000 is no rate of a 2F-85"),
    ],
)
def test_what_is_not_simulated_is_named(tmp_path: Path, before: str, after: str, problem: str) -> None:
    with pytest.raises(SimulationError, match=problem):
        buses_of(parse(HAND.replace(before, after), "hand.toml"), tmp_path)
