"""Who is on a line and under which id, found out and changed before a robot file names them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from trade.errors import ConfigurationError
from trade_drivers import Commissioner, ScannedDevice, scan
from trade_drivers.vendors.dynamixel import DynamixelDriver
from trade_drivers.vendors.feetech import FeetechDriver
from trade_drivers.vendors.robotiq import RobotiqDriver
from trade_hil_sim import DynamixelBus, Gripper, Late, Mute, RobotiqBus, Servo, WrongModel, motion_writes, writes
from trade_hil_sim.feetech import FeetechBus
from trade_hil_sim.feetech import Servo as FeetechServo

pytestmark = pytest.mark.virtual_time


class Make(NamedTuple):
    """One make of servo, simulated, and what sets it up."""

    commissioner: type[Commissioner]
    bus: Callable[..., Any]
    servo: Callable[..., Any]
    factory_baud: int
    other_baud: int
    model: str
    firmware: str
    torque: int


MAKES = {
    "dynamixel": Make(DynamixelDriver.commissioner, DynamixelBus, Servo, 57_600, 1_000_000, "XL430-W250", "45", 64),
    "feetech": Make(FeetechDriver.commissioner, FeetechBus, FeetechServo, 1_000_000, 500_000, "STS3215", "3.10", 40),
}


class Line:
    """A simulated line, and the servos on it."""

    def __init__(self, make: Make, tmp_path: Path, undo: ExitStack) -> None:
        self.make, self._tmp_path, self._undo = make, tmp_path, undo
        self.commissioner = make.commissioner()

    def plug(self, *ids: int, bauds: Sequence[int] = ()) -> None:
        servos = [
            self.make.servo(one, baud=baud, position_counts=2048 + 40 * number)
            for number, (one, baud) in enumerate(zip(ids, bauds or [self.make.factory_baud] * len(ids), strict=True))
        ]
        self.sim = self._undo.enter_context(self.make.bus(servos, self._tmp_path / "line", paced=False))
        self.port = str(self.sim.port)

    def scan(self, *ids: int, bauds: Sequence[int] = ()) -> list[ScannedDevice]:
        return scan(self.commissioner, self.port, bauds or [self.make.factory_baud], ids or range(4))

    def set_id(self, device_id: int, to: int) -> ScannedDevice:
        return self.commissioner.set_id(self.port, self.make.factory_baud, device_id, to)

    def switch_on(self, nth: int = 0) -> None:
        self.sim.devices[nth].write(self.make.torque, b"\x01", 0.0)

    def power_cycle(self) -> None:
        for servo in self.sim.devices:
            servo.reboot(0.0)
            servo.advance(1.0)

    @property
    def written(self) -> list[Any]:
        return writes(list(self.sim.log.entries))


@pytest.fixture(params=MAKES)
def line(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Line]:
    with ExitStack() as undo:
        yield Line(MAKES[request.param], tmp_path, undo)


def test_a_scan_names_the_devices_that_answer_and_writes_nothing(line: Line) -> None:
    line.plug(1, 3)
    first, second = line.scan()
    make = line.make
    assert (first.id, first.model, first.firmware, first.torque) == (1, make.model, make.firmware, False)
    assert (second.id, second.baud, second.problem) == (3, make.factory_baud, "")
    assert not line.written


def test_a_scan_reports_after_each_rate_what_it_found(line: Line) -> None:
    line.plug(1, 2, bauds=(line.make.factory_baud, line.make.other_baud))
    reported: list[tuple[int, int]] = []
    rates = [line.make.factory_baud, line.make.other_baud]
    found = scan(line.commissioner, line.port, rates, range(4), lambda baud, count: reported.append((baud, count)))
    assert [(one.id, one.baud) for one in found] == [(1, rates[0]), (2, rates[1])]
    assert reported == [(rates[0], 1), (rates[1], 1)]


def test_an_answer_that_comes_late_is_not_taken_for_another_device(line: Line) -> None:
    line.plug(1)
    line.sim.do(Late(ids=(1,), s=0.06, count=1))
    assert {one.id for one in line.scan()} <= {1}


def test_two_devices_of_one_id_are_one_finding_with_its_remedy(line: Line) -> None:
    line.plug(1, 1)
    [found] = line.scan()
    assert found.id == 1
    assert "Unplug all devices but one" in found.problem


def test_an_id_that_is_named_is_asked_again_if_its_answer_gets_lost(line: Line) -> None:
    line.plug(1)
    line.sim.do(Mute(count=2))
    [found] = line.scan(1)
    assert (found.id, found.problem) == (1, "")


def test_S07_a_scan_ends_at_the_first_device_whose_torque_is_on(line: Line) -> None:
    line.plug(1, 2)
    line.switch_on()
    with pytest.raises(ConfigurationError, match=f"id 1 .{line.make.model}.*torque on") as error:
        line.scan()
    assert line.port in str(error.value)
    assert not line.written


def test_a_port_that_a_driver_owns_is_not_scanned(line: Line) -> None:
    line.plug(1)
    bench = line.commissioner.open(line.port, line.make.factory_baud)
    try:
        with pytest.raises(ConfigurationError, match="another driver owns this port"):
            line.scan()
    finally:
        bench.close()


def test_a_port_that_is_not_there_is_named(line: Line, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="there is no such device"):
        scan(line.commissioner, str(tmp_path / "none"), [line.make.factory_baud])


def test_a_new_id_outlives_the_power_and_nothing_moves(line: Line) -> None:
    line.plug(1)
    now = line.set_id(1, 2)
    assert (now.id, now.model) == (2, line.make.model)
    line.power_cycle()
    assert [found.id for found in line.scan()] == [2]
    assert not motion_writes(list(line.sim.log.entries))


def test_two_factory_fresh_servos_get_their_ids_one_at_a_time(line: Line) -> None:
    line.plug(1, 1)
    with pytest.raises(ConfigurationError, match="Unplug all devices but one"):
        line.set_id(1, 2)
    assert not line.written
    line.sim.devices[1].absent = True
    line.set_id(1, 2)
    line.sim.devices[1].absent = False
    assert [(found.id, found.problem) for found in line.scan()] == [(1, ""), (2, "")]


def test_an_id_is_not_changed_while_torque_is_on(line: Line) -> None:
    line.plug(1)
    line.switch_on()
    with pytest.raises(ConfigurationError, match="torque is on"):
        line.set_id(1, 2)
    assert not line.written


@pytest.mark.parametrize(
    ("device_id", "to", "complaint"), [(1, 2, "id 2 is taken"), (3, 4, "no device answers"), (1, 999, "999 is not")]
)
def test_an_impossible_change_is_refused_before_anything_is_written(
    line: Line, device_id: int, to: int, complaint: str
) -> None:
    line.plug(1, 2)
    with pytest.raises(ConfigurationError, match=complaint):
        line.set_id(device_id, to)
    assert not line.written


def test_a_model_that_is_not_known_is_named_and_left_alone(line: Line) -> None:
    line.plug(1)
    line.sim.do(WrongModel(ids=(1,), number=999))
    [found] = line.scan()
    assert (found.model, found.torque) == ("model number 999", None)
    with pytest.raises(ConfigurationError, match="does not know that model"):
        line.set_id(1, 2)
    assert not line.written


def test_an_id_that_it_has_already_is_not_written_again(line: Line) -> None:
    line.plug(1)
    assert line.set_id(1, 1).id == 1
    assert not line.written


def test_an_answer_that_gets_lost_does_not_hide_that_the_id_was_changed(line: Line) -> None:
    line.plug(1)
    line.sim.do(Mute(instruction="write"))
    assert line.set_id(1, 2).id == 2


def test_an_answer_that_gets_lost_while_it_is_read_is_asked_for_again(line: Line) -> None:
    line.plug(1)
    line.sim.do(Mute(instruction="read", skip=1, count=1))
    [found] = line.scan(1)
    assert (found.model, found.problem) == (line.make.model, "")


def test_a_servo_that_answers_pings_but_not_reads_is_listed_with_that_problem(line: Line) -> None:
    line.plug(1)
    line.sim.do(Mute(instruction="read"))
    problems = ["register 68" in found.problem for found in line.scan(1)]
    assert problems == ([] if line.make is MAKES["feetech"] else [True])  # a Feetech servo reports no model then


def test_a_new_rate_outlives_the_power(line: Line) -> None:
    line.plug(1)
    make = line.make
    now = line.commissioner.set_baud(line.port, make.factory_baud, 1, make.other_baud)
    assert (now.id, now.baud) == (1, make.other_baud)
    line.power_cycle()
    assert not line.scan()
    assert [found.id for found in line.scan(bauds=[make.other_baud])] == [1]


def test_a_rate_at_which_the_id_is_taken_is_refused(line: Line) -> None:
    make = line.make
    line.plug(1, 1, bauds=(make.factory_baud, make.other_baud))
    with pytest.raises(ConfigurationError, match=f"id 1 is taken at {make.other_baud} baud"):
        line.commissioner.set_baud(line.port, make.factory_baud, 1, make.other_baud)
    with pytest.raises(ConfigurationError, match="123 is no rate"):
        line.commissioner.set_baud(line.port, make.factory_baud, 1, 123)
    assert not line.written


def test_a_feetech_servo_is_shut_against_writes_again(tmp_path: Path) -> None:
    with ExitStack() as undo:
        line = Line(MAKES["feetech"], tmp_path, undo)
        line.plug(1)
        line.set_id(1, 2)
        assert line.sim.devices[0].memory.get("lock") == 1
        line.commissioner.set_baud(line.port, 1_000_000, 2, 500_000)
        assert line.sim.devices[0].memory.get("lock") == 1


def test_a_scan_pings_no_single_id_when_the_broadcast_ping_gets_no_answer(tmp_path: Path) -> None:
    with ExitStack() as undo:
        line = Line(MAKES["dynamixel"], tmp_path, undo)
        line.plug(1)
        line.sim.devices[0].absent = True
        assert not scan(line.commissioner, line.port, [57_600])
        asked = [entry.device_id for entry in line.sim.log.entries if entry.kind == "instruction"]
        assert asked == [254]


def test_a_gripper_is_found_and_its_id_is_left_to_its_vendor(tmp_path: Path) -> None:
    with RobotiqBus([Gripper(9)], tmp_path / "hand", paced=False) as sim:
        found = scan(RobotiqDriver.commissioner(), str(sim.port), ids=range(8, 11))
        assert [(one.id, one.model, one.torque) for one in found] == [(9, "2F-85", None)]
        with pytest.raises(ConfigurationError, match="vendor's tool"):
            RobotiqDriver.commissioner().set_id(str(sim.port), 115_200, 9, 10)
        assert not writes(list(sim.log.entries))
