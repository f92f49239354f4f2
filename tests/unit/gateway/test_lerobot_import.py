"""``trade calibrate --from``: a calibration of LeRobot in a robot file, in the zero and the range that it means."""

import json
from contextlib import ExitStack
from math import tau
from pathlib import Path
from typing import Any

import pytest
import serial  # noqa: F401 - virtual time misses its first import
from typer.testing import CliRunner, Result

from trade.errors import ConfigurationError
from trade_drivers import Joint, attach, load
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_hil_sim import events, writes
from trade_hil_sim.feetech import FeetechBus

NAMES = ("shoulder_pan", "elbow_flex", "wrist_roll")
JOINT = """
[joint."{bus}.{name}"]
bus = "{bus}"
id = {id}
model = "STS3215"
min_rad = -0.1          # `trade calibrate` measures both
max_rad = 0.1
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0
"""
BUS = '\n[bus.{bus}]\ndriver = "feetech"\nport = "/dev/tty{bus}"\n'
ARM: dict[str, dict[str, Any]] = {
    "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -85, "range_min": 746, "range_max": 3477},
    "elbow_flex": {"id": 2, "drive_mode": 0, "homing_offset": 1437, "range_min": 812, "range_max": 3021},
    "wrist_roll": {"id": 3, "drive_mode": 0, "homing_offset": -2047, "range_min": 0, "range_max": 4095},
}


def arm(bus: str, names: tuple[str, ...] = NAMES) -> str:
    return BUS.format(bus=bus) + "".join(JOINT.format(bus=bus, name=name, id=n) for n, name in enumerate(names, 1))


class Bench:
    """A robot file, a calibration, and the command."""

    def __init__(self, folder: Path) -> None:
        self.file, self.source = folder / "so101.toml", folder / "arm.json"
        self.write(arm("follower"))
        self.calibration(ARM)

    def write(self, text: str) -> None:
        self.text = '[robot]\nname = "so101"\n' + text
        self.file.write_text(self.text, encoding="utf-8")

    def calibration(self, motors: object, before: bytes = b"") -> None:
        self.source.write_bytes(before + json.dumps(motors).encode())

    def run(self, *words: str, joint: str = "") -> Result:
        named = [joint] if joint else []
        return CliRunner().invoke(
            app, ["calibrate", str(self.file), *named, "--from", str(self.source), "--yes", *words]
        )

    def joints(self) -> dict[str, Joint]:
        return {one.name: one for one in load(self.file).joints}

    def refused(self, says: str, *words: str) -> None:
        error = self.run(*words).exception
        assert isinstance(error, ConfigurationError)
        assert says in str(error)
        assert self.file.read_text(encoding="utf-8") == self.text


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_offsets_and_ranges_are_those_of_the_file_and_no_wider(bench: Bench) -> None:
    said = bench.run()
    assert said.exit_code == 0, said.output
    for name, motor in ARM.items():
        joint = bench.joints()[f"follower.{name}"]
        assert (joint.homing_counts, joint.offset_rad) == (motor["homing_offset"], 0.0)
        low, high = ((motor[end] - 2048) * tau / 4096 for end in ("range_min", "range_max"))
        assert low <= joint.min_rad < low + 1e-4
        assert high - 1e-4 < joint.max_rad <= high
    assert "# `trade calibrate` measures both" in bench.file.read_text(encoding="utf-8")


def test_it_says_which_zero_it_is_and_where_lerobots_is(bench: Bench) -> None:
    said = " ".join(bench.run().output.split())
    assert "follower.shoulder_pan: 0 rad is count 2048, the pose in which LeRobot took its homing offset" in said
    assert "its degrees count from the middle of the range, at 0.0974 rad" in said
    assert "follower.wrist_roll: its range is a whole turn." in said
    assert "follower.elbow_flex: its range is a whole turn." not in said


def test_a_reversed_joint_has_the_same_range_in_its_own_direction(bench: Bench) -> None:
    bench.write(arm("follower").replace("id = 1\n", "id = 1\nreversed = true\noffset_rad = 0.3\n"))
    assert bench.run().exit_code == 0
    joint = bench.joints()["follower.shoulder_pan"]
    assert (joint.min_rad, joint.max_rad, joint.offset_rad) == (-2.192, 1.9972, 0.0)


def test_one_joint_alone_and_a_byte_order_mark(bench: Bench) -> None:
    bench.calibration(ARM, before=b"\xef\xbb\xbf")
    assert bench.run(joint="follower.elbow_flex").exit_code == 0
    offsets = {name: one.homing_counts for name, one in bench.joints().items()}
    assert offsets == {"follower.shoulder_pan": 0, "follower.elbow_flex": 1437, "follower.wrist_roll": 0}


def test_of_two_arms_on_two_buses_one_is_named(bench: Bench) -> None:
    bench.write(arm("follower") + arm("leader"))
    bench.refused("fits the buses follower and leader; choose one with --bus")
    assert bench.run("--bus", "leader").exit_code == 0
    offsets = {name: one.homing_counts for name, one in bench.joints().items()}
    assert (offsets["follower.shoulder_pan"], offsets["leader.shoulder_pan"]) == (0, -85)


def changed(name: str, **values: object) -> dict[str, Any]:
    return ARM | {name: ARM[name] | values}


@pytest.mark.parametrize(
    ("motors", "says"),
    [
        (changed("wrist_roll", id=9), "is the calibration of another arm than"),
        (changed("wrist_roll", id=9), "it has ids 1, 2, 9, but bus follower has 1, 2, 3"),
        (
            changed("wrist_roll", id=2) | {"elbow_flex": ARM["elbow_flex"] | {"id": 3}},
            "has elbow_flex as id 3, but joint follower.elbow_flex has id 2: that is another arm",
        ),
        (changed("wrist_roll", id=2), "has two motors of one id; it has ids 1, 2, 2"),
        (changed("elbow_flex", homing_offset=-2590), "arm.json: elbow_flex: homing_offset -2590 is more than"),
        (changed("elbow_flex", range_min=-12), "range -12 to 3021 is none within 0 to 4095"),
        (changed("elbow_flex", range_max=4200), "range 812 to 4200 is none within 0 to 4095"),
        (changed("elbow_flex", range_min=3021, range_max=812), "range 3021 to 812 is none"),
        ({"homing_offset": [1, 2], "motor_names": ["a", "b"]}, "is no calibration of LeRobot"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_and_changes_nothing(
    bench: Bench, motors: object, says: str
) -> None:
    bench.calibration(motors)
    bench.refused(says)


@pytest.mark.parametrize("words", [("--zero-here",), ("--range-from-motion", "5")])
def test_to_import_and_to_measure_are_not_mixed(bench: Bench, words: tuple[str, ...]) -> None:
    assert isinstance(bench.run(*words).exception, UsageError)


def test_a_calibration_in_another_encoding_is_refused_by_its_name(bench: Bench) -> None:
    bench.source.write_bytes(json.dumps(ARM).encode("utf-16"))
    bench.refused("byte-order mark of UTF-16")


def test_to_measure_needs_a_joint(bench: Bench) -> None:
    error = CliRunner().invoke(app, ["calibrate", str(bench.file)]).exception
    assert isinstance(error, UsageError)
    assert "name the joint to measure" in str(error)


@pytest.mark.virtual_time
def test_the_imported_arm_works_on_servos_that_lerobot_has_set_up(bench: Bench, tmp_path: Path) -> None:
    assert bench.run().exit_code == 0
    robot = load(bench.file)
    with ExitStack() as undo:
        sim = FeetechBus.from_robot(robot.buses[0], robot.joints, tmp_path / "arm", paced=False)  # type: ignore[arg-type]
        for servo, motor in zip(sim.devices, ARM.values(), strict=True):
            for name, value in (("min_angle", motor["range_min"]), ("max_angle", motor["range_max"])):
                servo.memory.set(name, value)
                servo.memory.keep(name)
        undo.enter_context(sim)
        arm = attach(robot, ports={"follower": str(sim.port)}, announced=False)
        undo.callback(arm.close)
        assert not writes(list(sim.log.entries), register="homing_offset")
        for joint in robot.joints:
            motor = arm.motor(joint.name)
            motor.enable()
            motor.move_to(joint.max_rad)
            at = events(list(sim.log.entries), "at_rest", device_id=joint.id)[-1].position_counts
            assert at == ARM[joint.name.partition(".")[2]]["range_max"]
