"""Zero and range out of readings, and into a robot file whose comments stay; the hand is simulated."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from math import inf, pi, tau
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from tests.support.simulated_robots import HAND, HEAD
from trade.errors import ConfigurationError, WrongDevice
from trade_drivers import Joint, WireError, parse
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli.hardware._calibrate import Sweep, TravelEnds, _measure, homed, measured, with_values
from trade_gateway.terminal._output import Output
from trade_hil_sim import DynamixelBus, writes

pytestmark = pytest.mark.virtual_time


def joint(**changes: Any) -> Joint:
    values: dict[str, Any] = {"min_rad": -1.0, "max_rad": 1.0, "max_speed_rad_s": 1.0, "max_accel_rad_s2": 10.0}
    return Joint(name="neck.pan", bus="neck", id=1, model="XL430-W250", **values | changes)


def test_the_zero_becomes_the_offset_and_the_range_ends_inside_of_what_was_reached() -> None:
    assert measured(joint(), 0.5, TravelEnds(-1.0, 1.5, 0.0)) == {"offset_rad": -0.5, "min_rad": -1.48, "max_rad": 0.98}


def test_a_joint_that_turns_against_its_device_keeps_its_sense() -> None:
    assert measured(joint(reversed=True), 0.5, TravelEnds(-1.0, 1.5, 0.0)) == {
        "offset_rad": 0.5,
        "min_rad": -0.98,
        "max_rad": 1.48,
    }


def test_a_range_alone_is_measured_from_the_zero_that_the_file_has() -> None:
    assert measured(joint(offset_rad=0.25), None, TravelEnds(-1.0, 1.0, 0.0)) == {"min_rad": -0.73, "max_rad": 1.23}
    assert measured(joint(), 0.0, None) == {"offset_rad": 0.0}


def test_a_joint_that_was_hardly_moved_gets_no_range() -> None:
    with pytest.raises(ConfigurationError, match="from one end to the other"):
        measured(joint(), None, TravelEnds(0.0, 0.05, 0.0))


PLACE = "neck.pan (id 1 on /dev/ttyUSB0)"


class Hand:
    """A bench whose device is where a hand has moved it."""

    def __init__(self, angles: Sequence[float]) -> None:
        self._angles = iter(angles)

    def angle_rad(self, device_id: int) -> float:
        return next(self._angles)


class Loose(Hand):
    """Its plug is loose: some questions are not answered."""

    def __init__(self, angles: Sequence[float], missed: float) -> None:
        super().__init__(angles)
        self._missed = missed

    def angle_rad(self, device_id: int) -> float:
        self._missed -= 1
        if self._missed >= 0:
            raise WireError(f"id {device_id} did not answer within 51 ms")
        return super().angle_rad(device_id)


def done_after(looks: int) -> Callable[[], bool]:
    left = iter([False] * looks)
    return lambda: next(left, True)


def test_a_sweep_knows_both_ends_and_where_it_stopped() -> None:
    ends = Sweep(Hand([0.0, 1.0, -2.0, 0.5]), 1, PLACE).until(done_after(3), 60.0)  # type: ignore[arg-type]
    assert ends == TravelEnds(-2.0, 1.0, 0.5)


def test_answers_that_are_missed_for_a_moment_throw_nothing_away() -> None:
    ends = Sweep(Loose([0.0, 1.0, -2.0], 10), 1, PLACE).until(done_after(2), 60.0)  # type: ignore[arg-type]
    assert ends == TravelEnds(-2.0, 1.0, -2.0)


def test_a_device_that_stops_answering_is_named_once_with_its_port() -> None:
    with pytest.raises(ConfigurationError) as gone:
        Sweep(Loose([], inf), 1, PLACE, patience_s=0.05).read()  # type: ignore[arg-type]
    said = f"{PLACE}: did not answer within 51 ms, asked for 0.05 s; check its cable. Nothing was written"
    assert str(gone.value) == said


def angles(*counts: int) -> list[float]:
    return [(count - 2048) * tau / 4096 for count in counts]


@pytest.mark.parametrize(
    ("counts", "wide"),
    [
        ([3900, 4095, 0, 200], 396),
        ([200, 0, 4095, 3900, 4095, 0, 100], 396),
        ([3900, 4000, 4095], 195),
        ([2048, 3900, 4095, 0, 200, 0, 4095, 3900, 2048], 2248),
    ],
)
def test_a_sweep_past_the_end_of_the_encoder_is_as_wide_as_it_is(counts: list[int], wide: int) -> None:
    ends = Sweep(Hand(angles(*counts)), 1, PLACE).until(done_after(len(counts) - 1), 60.0)  # type: ignore[arg-type]
    assert ends.high - ends.low == pytest.approx(wide * tau / 4096)
    assert ends.last == pytest.approx(angles(counts[-1])[0])


@pytest.mark.parametrize("beyond", [angles(3900, 4095, 0, 200), angles(200, 0, 4095, 3900), [3.0, pi + 0.1]])
def test_a_range_past_the_end_of_the_encoder_is_refused_with_its_width(beyond: list[float]) -> None:
    ends = Sweep(Hand(beyond), 1, PLACE).until(done_after(len(beyond) - 1), 60.0)  # type: ignore[arg-type]
    wide = "0.607" if len(beyond) > 2 else "0.242"
    with pytest.raises(ConfigurationError, match=rf"{wide} rad wide, but passes .*mount its horn"):
        measured(joint(), None, ends)


@pytest.mark.parametrize(
    "counts", [[3900, 4095, 0, 200], [3000, 4095, 0, 1200, 2500], [4095, 0, 100], [3800, 4095, 0, 200]]
)
@pytest.mark.parametrize("homing", [0, 300, -2000])
def test_the_homing_offset_that_a_refusal_names_lets_the_range_be_measured(counts: list[int], homing: int) -> None:
    """A Feetech servo reports its raw counts less the offset, within one turn."""
    before = joint(homing_counts=homing)
    with pytest.raises(ConfigurationError, match="register 31") as refusal:
        measured(before, None, Sweep(Hand(angles(*counts)), 1, PLACE).until(done_after(len(counts) - 1), 60.0))  # type: ignore[arg-type]
    offset = int(str(refusal.value).partition("homing_counts = ")[2].split()[0])
    assert -2047 <= offset <= 2047
    moved = angles(*((count + homing - offset) % 4096 for count in counts))
    ends = Sweep(Hand(moved), 1, PLACE).until(done_after(len(moved) - 1), 60.0)  # type: ignore[arg-type]
    found = measured(before, None, ends)
    assert found["max_rad"] + found["min_rad"] == pytest.approx(0.0, abs=0.01)


def test_a_zero_and_a_range_beside_the_end_of_the_encoder_are_measured() -> None:
    sweep: Any = Sweep(Hand(angles(200, 0, 4095, 3950, 3950, 3900, 4095)), 1, PLACE)  # type: ignore[arg-type]
    zero = sweep.until(done_after(3), 60.0).last
    assert measured(joint(), zero, sweep.until(done_after(2), 60.0)) == {
        "offset_rad": -2.9176,
        "min_rad": -0.0567,
        "max_rad": 0.2024,
    }


def test_a_joint_that_turns_round_and_round_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="more than a whole turn"):
        Sweep(Hand(angles(0, 1500, 3000, 100, 1500)), 1, PLACE).until(done_after(4), 60.0)  # type: ignore[arg-type]


def test_a_prompt_without_an_answer_ends_the_measurement() -> None:
    with pytest.raises(ConfigurationError, match="no answer to the prompt"):
        Sweep(Hand([0.0, 0.0, 0.0]), 1, PLACE).until(lambda: False, 0.0)  # type: ignore[arg-type]


def test_the_zero_of_a_joint_that_moves_is_refused() -> None:
    def zero(*angles: float) -> dict[str, float]:
        hand: Any = Hand(angles)
        return _measure(Output(as_json=False), joint(), Sweep(hand, 1, PLACE), zero_here=True, seconds=None)

    with pytest.raises(ConfigurationError, match=r"it moves \(by 0\.030 rad in .* s\); hold it still"):
        zero(0.5, 0.53)
    assert zero(0.5, 0.502) == {"offset_rad": -0.502}  # a hand is never quite still


COMMENTED = HEAD.replace("min_rad = -1.4", "min_rad = -1.4   # the left shoulder").replace(
    '[joint."neck.tilt"]', '# nods\n[joint."neck.tilt"]'
)


def test_only_the_values_change_and_a_new_key_is_above_the_range() -> None:
    changed = with_values(COMMENTED, "neck.pan", {"offset_rad": 0.2, "min_rad": -0.5})
    expected = COMMENTED.replace("min_rad = -1.4 ", "offset_rad = 0.2\nmin_rad = -0.5 ")
    assert changed == expected
    assert parse(changed, "head.toml").joints[0].offset_rad == 0.2


class Rosie:
    """A robot file whose line is simulated, and its command."""

    def __init__(self, folder: Path, undo: ExitStack) -> None:
        robot = parse(COMMENTED, "head.toml")
        bus = robot.buses[0]
        self.sim = undo.enter_context(
            DynamixelBus.from_robot(bus, robot.joints_on(bus.name), folder / "neck", paced=False)  # type: ignore[arg-type]
        )
        self.file = folder / "head.toml"
        self.text = COMMENTED.replace("/dev/ttyNOWHERE", str(self.sim.port))
        self.file.write_text(self.text, encoding="utf-8")

    def calibrate(self, *words: str, says: str = "") -> Result:
        return CliRunner().invoke(app, ["calibrate", str(self.file), *words], input=says)


@pytest.fixture
def rosie(tmp_path: Path) -> Iterator[Rosie]:
    with ExitStack() as undo:
        yield Rosie(tmp_path, undo)


def test_zero_is_the_current_position_and_nothing_is_written_to_the_device(rosie: Rosie) -> None:
    rosie.sim.devices[0].place(2148, 0.0)
    said = rosie.calibrate("neck.pan", "--zero-here", "--yes")
    assert said.exit_code == 0, said.output
    assert "+offset_rad = -0.1534" in said.output
    assert rosie.file.read_text(encoding="utf-8") == rosie.text.replace(
        "min_rad = -1.4 ", "offset_rad = -0.1534\nmin_rad = -1.4 "
    )
    assert not writes(list(rosie.sim.log.entries))


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_line_ends_and_a_byte_order_mark_stay(rosie: Rosie, mark: bytes) -> None:
    rosie.file.write_bytes(mark + rosie.text.replace("\n", "\r\n").encode())
    rosie.sim.devices[0].place(2148, 0.0)
    said = rosie.calibrate("neck.pan", "--zero-here", "--yes")
    assert said.exit_code == 0, said.output
    expected = rosie.text.replace("min_rad = -1.4 ", "offset_rad = -0.1534\nmin_rad = -1.4 ")
    assert rosie.file.read_bytes() == mark + expected.replace("\n", "\r\n").encode()


def test_answering_no_leaves_the_file_unchanged(rosie: Rosie) -> None:
    rosie.sim.devices[0].place(2148, 0.0)
    said = rosie.calibrate("neck.pan", "--zero-here", says="n\n")
    assert said.exit_code == 1
    assert rosie.file.read_text(encoding="utf-8") == rosie.text


def test_a_joint_under_torque_is_not_calibrated(rosie: Rosie) -> None:
    rosie.sim.devices[0].write(64, b"\x01", 0.0)
    error = rosie.calibrate("neck.pan", "--zero-here", "--yes").exception
    assert isinstance(error, ConfigurationError)
    assert "torque is on" in str(error)


def test_another_model_is_not_calibrated(rosie: Rosie) -> None:
    rosie.file.write_text(rosie.text.replace("XL430-W250", "XM430-W350"), encoding="utf-8")
    assert isinstance(rosie.calibrate("neck.pan", "--zero-here", "--yes").exception, WrongDevice)


def test_an_unknown_joint_is_refused_with_the_known_ones(rosie: Rosie) -> None:
    error = rosie.calibrate("neck.roll", "--zero-here").exception
    assert isinstance(error, UsageError)
    assert "there is neck.pan, neck.tilt" in str(error)


def test_a_gripper_is_activated_and_not_calibrated(rosie: Rosie) -> None:
    hand = HAND.partition("[bus.hand]")
    rosie.file.write_text(f"{rosie.text}\n{hand[1]}{hand[2]}", encoding="utf-8")
    error = rosie.calibrate("left.hand", "--zero-here").exception
    assert isinstance(error, UsageError)
    assert "a gripper is not calibrated; activate it: `trade call rosie.left.hand.activate`" in str(error)


def test_a_homing_offset_that_the_file_does_not_know_is_written_with_the_new_zero(rosie: Rosie) -> None:
    rosie.sim.devices[0].write(20, (100).to_bytes(4, "little"), 0.0)
    said = rosie.calibrate("neck.pan", "--zero-here", "--yes")
    assert said.exit_code == 0, said.output
    made = parse(rosie.file.read_text(encoding="utf-8"), "head.toml").joints[0]
    assert (made.homing_counts, made.offset_rad) == (100, -0.1534)
    assert "# the left shoulder" in rosie.file.read_text(encoding="utf-8")


def test_a_range_is_not_measured_from_a_zero_that_has_moved() -> None:
    with pytest.raises(WrongDevice, match="the robot file says 0, but the device says 100"):
        homed(joint(), 100, zero_measured=False)
    assert homed(joint(homing_counts=100), 100, zero_measured=False) == {}
