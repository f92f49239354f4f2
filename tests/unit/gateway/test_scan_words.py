"""``trade scan`` and its kind: their words, what they show, and the robot file to begin with."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from trade.errors import ConfigurationError
from trade_drivers import ScannedDevice, attach, load, parse
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli.hardware._robot_file_template import first_file
from trade_gateway.cli.hardware._scan import _numbers
from trade_hil_sim import Arm, DynamixelBus, Mute, Servo, UrBus, motion_writes, writes
from trade_hil_sim.damiao import DamiaoBus, Motor
from trade_hil_sim.feetech import FeetechBus
from trade_hil_sim.feetech import Servo as FeetechServo
from trade_hil_sim.odrive import Axis, OdriveBus

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def line(tmp_path: Path) -> Iterator[DynamixelBus]:
    with DynamixelBus([Servo(1), Servo(2, position_counts=2100)], tmp_path / "line", paced=False) as sim:
        yield sim


def trade(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_ids_are_numbers_and_ranges() -> None:
    assert _numbers("1-3,9", "--ids") == [1, 2, 3, 9]
    assert _numbers(None, "--ids") == []
    with pytest.raises(UsageError, match="neither a number nor a range"):
        _numbers("1-x", "--ids")


def test_a_scan_shows_a_line_for_each_device(line: DynamixelBus) -> None:
    said = trade("scan", "--port", line.port, "--bauds", 1_000_000, "--ids", "1-3")
    assert said.exit_code == 0, said.output
    assert "dynamixel at 1000000 baud: 2" in said.output
    assert [row.split()[1:4] for row in said.output.splitlines()[-2:]] == [
        ["1000000", "1", "XL430-W250"],
        ["1000000", "2", "XL430-W250"],
    ]


@pytest.mark.parametrize(("homing", "written"), [(-85, True), (0, False)])
def test_a_robot_file_of_servos_that_another_program_has_homed_comes_up(
    tmp_path: Path, homing: int, written: bool
) -> None:
    servo = FeetechServo(3)
    servo.memory.set("homing_offset", homing)
    with FeetechBus([servo], tmp_path / "line", paced=False) as sim:
        file = tmp_path / "arm.toml"
        said = trade(
            "scan", "--port", sim.port, "--driver", "feetech", "--bauds", 1_000_000, "--ids", 3, "--write", file
        )
        assert said.exit_code == 0, said.output
        assert (f"homing_counts = {homing}" in file.read_text()) == written
        attach(load(file), announced=False).close()
        assert not motion_writes(list(sim.log.entries))


def test_a_program_gets_them_as_json(line: DynamixelBus) -> None:
    said = trade("scan", "--port", line.port, "--bauds", 1_000_000, "--ids", "2", "--json")
    [found] = json.loads(said.stdout)
    assert (found["port"], found["id"], found["torque"], found["problem"]) == (str(line.port), 2, False, "")


def test_finding_no_container_has_an_exit_code_of_its_own(line: DynamixelBus) -> None:
    said = trade("scan", "--port", line.port, "--bauds", 1_000_000, "--ids", "7", "--driver", "dynamixel")
    assert said.exit_code == 1
    assert "no device answers" in said.output


def test_what_was_found_becomes_a_robot_file_that_is_not_written_over(line: DynamixelBus, tmp_path: Path) -> None:
    words = ("scan", "--port", line.port, "--bauds", 1_000_000, "--ids", "1-2", "--write", tmp_path / "new.toml")
    assert trade(*words).exit_code == 0
    robot = parse((tmp_path / "new.toml").read_text(encoding="utf-8"), "new.toml")
    assert [(joint.id, joint.firmware) for joint in robot.joints] == [(1, "45"), (2, "45")]
    assert robot.buses[0].port == str(line.port)
    assert isinstance(trade(*words).exception, UsageError)


@pytest.mark.parametrize(
    ("second", "complaint"),
    [
        ({"problem": "two share it"}, "two share it"),
        ({"baud": 57_600}, "57600 and 1000000 baud"),
        ({"driver": "feetech"}, "drivers dynamixel and feetech"),
    ],
)
def test_contradictions_within_one_robot_file_are_reported(second: dict[str, object], complaint: str) -> None:
    one = ScannedDevice(driver="dynamixel", baud=1_000_000, id=1, model="XL430-W250")
    other = ScannedDevice(**{"driver": "dynamixel", "baud": 1_000_000, "id": 2, "model": "XL430-W250"} | second)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=complaint):
        first_file([("/dev/a", one), ("/dev/a", other)], Path("new.toml"))


def test_an_id_is_set_where_the_device_is_found(line: DynamixelBus) -> None:
    said = trade("set-id", "--port", line.port, "--from", 2, "--to", 5)
    assert said.exit_code == 0, said.output
    assert "XL430-W250 has id 5 now (it had 2)" in said.output
    assert [servo.device_id for servo in line.devices] == [1, 5]


def test_another_model_than_the_one_meant_is_left_alone(line: DynamixelBus) -> None:
    error = trade("set-id", "--port", line.port, "--from", 2, "--to", 5, "--model", "XM430-W350").exception
    assert "is XL430-W250, not XM430-W350" in str(error)
    assert [servo.device_id for servo in line.devices] == [1, 2]


def test_a_device_whose_model_could_not_be_read_is_left_alone(line: DynamixelBus) -> None:
    line.do(Mute(ids=(2,), instruction="read", count=3))
    words = ("--port", line.port, "--baud", 1_000_000, "--from", 2, "--to", 5, "--model", "XM430-W350")
    error = trade("set-id", *words).exception
    assert isinstance(error, ConfigurationError), error
    assert "answers a ping but no read" in str(error)
    assert [servo.device_id for servo in line.devices] == [1, 2]
    assert not writes(line.log.entries)


def test_a_rate_is_set_where_the_device_is_found(line: DynamixelBus) -> None:
    said = trade("set-baud", "--port", line.port, "--id", 2, "--to", 115_200, "--baud", 1_000_000)
    assert said.exit_code == 0, said.output
    assert [servo.baud for servo in line.devices] == [1_000_000, 115_200]


def test_an_arm_is_asked_for_by_its_host(tmp_path: Path) -> None:
    with UrBus(Arm(name="right"), name="ur") as sim:
        said = trade("scan", "--host", sim.port, "--write", tmp_path / "arm.toml")
    assert said.exit_code == 0, said.output
    robot = parse((tmp_path / "arm.toml").read_text(encoding="utf-8"), "arm.toml")
    assert [(arm.model, arm.bus) for arm in robot.arms] == [("UR5e", robot.buses[0].name)]
    assert robot.buses[0].port == sim.port


@pytest.mark.parametrize(
    ("bus", "device", "model"), [(OdriveBus, Axis, "ODrive S1"), (DamiaoBus, Motor, "DM4310")], ids=["odrive", "damiao"]
)
def test_motors_on_a_can_bus_become_a_robot_file(bus: Any, device: Any, model: str, tmp_path: Path) -> None:
    now = time.monotonic()
    with bus([device(3, t=now), device(4, t=now)]) as sim:
        port = sim.port
        said = trade("scan", "--port", port, "--ids", "3-4", "--write", tmp_path / "can.toml")
    assert said.exit_code == 0, said.output
    robot = parse((tmp_path / "can.toml").read_text(encoding="utf-8"), "can.toml")
    assert [(joint.id, joint.model) for joint in robot.joints] == [(3, model), (4, model)]
    assert robot.buses[0].port == port
    assert ("not scanned for: driver cia402: ODrives talk" in said.output) == (bus is OdriveBus)


def test_a_host_without_a_controller_is_named() -> None:
    error = trade("scan", "--host", "127.255.255.1").exception
    assert isinstance(error, ConfigurationError)
    assert "127.255.255.1: no controller of an arm answers" in str(error)


def test_a_driver_whose_devices_are_set_up_otherwise_says_so(line: DynamixelBus) -> None:
    error = trade("scan", "--port", line.port, "--driver", "ur").exception
    assert isinstance(error, ConfigurationError)
    assert "driver ur has no scan" in str(error)


def test_a_scan_that_finds_a_problem_ends_with_its_exit_code(tmp_path: Path) -> None:
    with DynamixelBus([Servo(1), Servo(1)], tmp_path / "line", paced=False) as sim:
        said = trade("scan", "--port", sim.port, "--bauds", 1_000_000, "--ids", "1-3", "--driver", "dynamixel")
    assert "Unplug all devices but one" in said.output
    assert said.exit_code == 1


@pytest.mark.realtime
@pytest.mark.parametrize(
    "words",
    [
        ("scan", "--bauds", "1000000", "--driver", "dynamixel"),
        ("set-id", "--from", "1", "--to", "2", "--driver", "dynamixel"),
        ("scan", "--bauds", "1000000", "--driver", "feetech"),
        ("scan", "--driver", "robotiq"),
    ],
    ids=" ".join,
)
def test_an_invalid_port_is_named_without_a_key_that_is_not_in_the_file(tmp_path: Path, words: tuple[str, ...]) -> None:
    (tmp_path / "no").write_text("no port", encoding="utf-8")
    error = trade(*words, "--port", tmp_path / "no").exception
    assert str(error).startswith(f"{tmp_path / 'no'}: is not a serial port")
