"""Complaints of other projects about plans that are refused, clocks that step, and files of other systems."""

import codecs
from pathlib import Path

import pytest

from tests.contract.complaints import plan_mutants as mutants
from tests.contract.complaints.bodies import Body, outcome
from tests.contract.complaints.table import complaint
from tests.contract.test_profiles import trapezoid
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.test_profiles import plan, rows
from tests.unit.gateway.test_text_files import KINDS
from tests.unit.gateway.test_timeline import LASTS_S, WallClock, recorded
from trade_drivers import Tolerances
from trade_gateway.config.document import Document
from trade_gateway.recording._motion import motion_of, motions


@pytest.mark.realtime
@complaint(
    ("dynamixel", mutants.every_piece_is_cubic, "it was refused: LimitExceeded"),
    ("cia402", mutants.every_piece_is_cubic, "it was refused: LimitExceeded"),
    ("dynamixel", mutants.a_piece_takes_the_acceleration_that_it_needs, "it was followed beyond its limits"),
    also=("feetech", "damiao"),
)
def test_a_plan_within_the_limits_is_refused(body: Body) -> None:
    robot = body.attach()
    group = robot.group(body.rig.robot.groups[0].name)
    group.enable()
    starts, limits = [state.position_rad for state in group.state()], group.limits()[0]
    mark = written_now()
    wide, end_rad = Tolerances(path_rad=1.0), 0.9 * limits.max_rad
    for factor in (1.1, 1.3):
        beyond = trapezoid(group.joints(), starts, limits, end_rad, factor)
        refusal = outcome(lambda beyond=beyond: group.follow(beyond, wide))  # type: ignore[misc]
        assert refusal.startswith("LimitExceeded"), "it was followed beyond its limits"
    assert not body.events("motion_started", mark)
    refusal = outcome(lambda: group.follow(trapezoid(group.joints(), starts, limits, end_rad, 1.0), wide))
    assert not refusal, f"it was refused: {refusal}"
    assert abs(body.truth.position_rad - end_rad) < 0.03


@complaint(
    ("folder", mutants.rest_is_exactly_0, "it was refused: InvalidArgument.*at the last point"),
    ("folder", mutants.the_first_time_is_exactly_0, "it was refused: InvalidArgument.*the first is"),
    ("folder", mutants.every_last_speed_is_rest, "a motion without an end was accepted"),
)
def test_a_plan_that_ends_almost_at_rest_is_refused(_: object) -> None:
    for first_s, last_rad_s in ((0.0, 1e-12), (0.0, 4e-7), (0.0, -5e-5), (1e-9, 0.0)):
        almost = rows((first_s, 0.0, 0.0), (1.0, 0.5, last_rad_s))
        refusal = outcome(lambda almost=almost: plan(almost))  # type: ignore[misc]
        assert not refusal, f"it was refused: {refusal}"
    refusal = outcome(lambda: plan(rows((0.0, 0.0, 0.0), (1.0, 0.5, 0.05))))
    assert "rosie.joint still has 0.05 rad/s" in refusal, "a motion without an end was accepted"


@pytest.mark.virtual_time
@complaint(("folder", mutants.samples_have_the_time_of_the_wall_clock, "the recording (lasts|is damaged)"))
def test_the_clock_steps_during_a_recording(folder: Path) -> None:
    for number, by_s in enumerate((-3600.0, -2.0, 2.0)):
        file = folder / f"{number}.mcap"
        with pytest.MonkeyPatch.context() as patch:
            recorded(file, WallClock(patch), by_s)
        [(group, states)] = motions(file).items()
        refusal = outcome(lambda group=group, states=states: motion_of(group, states))  # type: ignore[misc]
        assert not refusal, f"the recording is damaged: {refusal}"
        lasts_s = motion_of(group, states).duration_s
        assert abs(lasts_s - LASTS_S) < 0.2, f"the recording lasts {lasts_s:.1f} s"


@complaint(
    ("folder", mutants.a_byte_order_mark_is_text, "a file is refused: "),
    ("folder", mutants.lines_end_as_on_unix, "its line ends have changed"),
)
def test_a_byte_order_mark_breaks_a_file(folder: Path) -> None:
    for kind, (text, read) in KINDS.items():
        file = folder / kind.replace(" ", "_") / "file.toml"
        file.parent.mkdir()
        file.write_bytes(codecs.BOM_UTF8 + text.encode())
        refusal = outcome(lambda read=read, file=file: read(file))  # type: ignore[misc]
        assert not refusal, f"a file is refused: {refusal}"
    policy = folder / "policy.toml"
    policy.write_bytes(b"a = 1\r\n")
    document = Document(policy)
    document.write("a = 1\nb = 2\n", document.read().version, lambda: None)
    assert policy.read_bytes() == b"a = 1\r\nb = 2\r\n", "its line ends have changed"
