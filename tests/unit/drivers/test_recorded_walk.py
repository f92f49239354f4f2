"""A walk as others see it: python-can records the frames in candump's format, cantools decodes them by a DBC.

The DBC is written here by hand from what the frames carry (CiA 402-2, docs/drivers.md): no driver table is used.
"""

import threading
from math import tau
from pathlib import Path
from typing import Any, NamedTuple

import can
import cantools
import pytest
from cantools.database import Database

from tests.support.waiting import PATIENCE_S
from tests.unit.drivers.legs import PATIENT, Leg, rig

pytestmark = pytest.mark.virtual_time

__all__ = ["rig"]

JOINT = """
BO_ {rpdo1} {joint}_COMMAND: 6 HOST
 SG_ SwitchOn : 0|1@1+ (1,0) [0|1] "" DRIVES
 SG_ EnableOperation : 3|1@1+ (1,0) [0|1] "" DRIVES
 SG_ NewSetPoint : 4|1@1+ (1,0) [0|1] "" DRIVES
 SG_ Halt : 8|1@1+ (1,0) [0|1] "" DRIVES
 SG_ Target : 16|32@1- ({rad},{offset}) [0|0] "rad" DRIVES

BO_ {rpdo2} {joint}_PROFILE: 8 HOST
 SG_ Speed : 0|32@1+ ({size},0) [0|0] "rad/s" DRIVES
 SG_ Acceleration : 32|32@1+ ({size},0) [0|0] "rad/s2" DRIVES

BO_ {tpdo1} {joint}_STATUS: 8 DRIVES
 SG_ OperationEnabled : 2|1@1+ (1,0) [0|1] "" HOST
 SG_ Fault : 3|1@1+ (1,0) [0|1] "" HOST
 SG_ TargetReached : 10|1@1+ (1,0) [0|1] "" HOST
 SG_ Position : 16|32@1- ({rad},{offset}) [0|0] "rad" HOST
 SG_ Torque : 48|16@1- (0.001,0) [0|0] "" HOST

BO_ {tpdo2} {joint}_MOTION: 7 DRIVES
 SG_ Velocity : 0|32@1- ({rad},0) [0|0] "rad/s" HOST
 SG_ Mode : 32|8@1- (1,0) [0|0] "" HOST
 SG_ ErrorCode : 40|16@1+ (1,0) [0|0] "" HOST
"""
RAD = tau / (4096 * 50)
"""Of one count of the drives in the robot file."""
END = 0x7FE
SYNC = 0x080
STEPS = ([0.3, 0.5], [-0.2, 0.1], [0.4, -0.3], [0.0, 0.2])
MAX_SPEED_RAD_S = 2.0


class Seen(NamedTuple):
    """One frame that the DBC knows; SYNC is empty."""

    t: float
    name: str
    signals: dict[str, Any]


def walk_database() -> Database:
    """Node 1 is the hip, node 2 the knee, turned the other way and 0.2 rad further."""
    text = 'VERSION "1"\n\nBS_:\n\nBU_: HOST DRIVES\n'
    for node, joint, sign, offset in ((1, "HIP", "", 0.0), (2, "KNEE", "-", 0.2)):
        ids = {"tpdo1": 0x180 + node, "rpdo1": 0x200 + node, "tpdo2": 0x280 + node, "rpdo2": 0x300 + node}
        text += JOINT.format(joint=joint, rad=f"{sign}{RAD!r}", size=repr(RAD), offset=offset, **ids)
    return cantools.database.load_string(text, "dbc")  # type: ignore[return-value]


class Recorder:
    """Plain python-can as one more client of the bus."""

    def __init__(self, leg: Leg, file: Path) -> None:
        self._leg, self._file = leg, file
        self._bus = leg.listen()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def _run(self) -> None:
        with can.CanutilsLogWriter(self._file) as log:
            while (heard := self._bus.recv(PATIENCE_S)) is not None and heard.arbitration_id != END:
                log.on_message_received(heard)

    def end(self) -> None:
        """All that was sent until now is in the file then."""
        with self._leg.listen() as other:
            other.send(can.Message(arbitration_id=END, is_extended_id=False))
            self._thread.join(PATIENCE_S)
        self._bus.shutdown()


@pytest.fixture
def walk(rig: Leg, tmp_path: Path) -> list[Seen]:
    """What was on the bus while the leg made its steps."""
    leg = rig
    leg.configure(PATIENT)
    leg.plug()
    robot = leg.attach()
    robot.group("leg").enable()
    recorder = Recorder(leg, tmp_path / "walk.log")
    try:
        for step in STEPS:
            robot.group("leg").move_to(step)
    finally:
        recorder.end()
    database = walk_database()
    known = {message.frame_id for message in database.messages}
    seen: list[Seen] = []
    for frame in can.LogReader(tmp_path / "walk.log"):
        if frame.arbitration_id == SYNC:
            seen.append(Seen(frame.timestamp, "SYNC", {}))
        elif frame.arbitration_id in known:
            name = database.get_message_by_frame_id(frame.arbitration_id).name
            signals = database.decode_message(frame.arbitration_id, frame.data)
            seen.append(Seen(frame.timestamp, name, dict(signals)))  # type: ignore[call-overload]
    return seen


def test_a_walk_is_read_out_of_its_frames_by_cantools(walk: list[Seen]) -> None:
    raised = [frame for frame in walk if frame.name.endswith("COMMAND") and frame.signals["NewSetPoint"]]
    assert all(frame.signals["EnableOperation"] and not frame.signals["Halt"] for frame in raised)
    for joint, goals in zip(("HIP", "KNEE"), zip(*STEPS, strict=True), strict=True):
        commanded = [frame.signals["Target"] for frame in raised if frame.name == f"{joint}_COMMAND"]
        assert commanded == pytest.approx(goals, abs=RAD)
        assert arrivals(walk, joint) == pytest.approx(goals, abs=0.01)
        reported = [frame.signals for frame in walk if frame.name == f"{joint}_STATUS"]
        assert len(reported) > 10 * len(STEPS)
        assert all(signals["OperationEnabled"] and not signals["Fault"] for signals in reported)
        motion = [frame.signals for frame in walk if frame.name == f"{joint}_MOTION"]
        assert {(signals["Mode"], signals["ErrorCode"]) for signals in motion} == {(1, 0)}
        assert 0.1 < max(abs(signals["Velocity"]) for signals in motion) <= 1.01 * MAX_SPEED_RAD_S


def test_both_joints_of_a_walk_set_off_between_the_same_two_syncs(walk: list[Seen]) -> None:
    together: list[set[str]] = [set()]
    for frame in walk:
        if frame.name == "SYNC":
            together.append(set())
        elif frame.name.endswith("COMMAND") and frame.signals["NewSetPoint"]:
            together[-1].add(frame.name)
    assert [names for names in together if names] == [{"HIP_COMMAND", "KNEE_COMMAND"}] * len(STEPS)


def test_ramps_of_a_walk_are_sent_before_each_set_point_and_within_the_limits(walk: list[Seen]) -> None:
    for joint in ("HIP", "KNEE"):
        reported: dict[str, Any] | None = None
        for frame in walk:
            if frame.name == f"{joint}_PROFILE":
                reported = frame.signals
                assert 0 < reported["Speed"] <= MAX_SPEED_RAD_S + RAD
                assert 0 < reported["Acceleration"] <= 20.0 + RAD
            elif frame.name == f"{joint}_COMMAND" and frame.signals["NewSetPoint"]:
                assert reported is not None
                reported = None


def arrivals(walk: list[Seen], joint: str) -> list[float]:
    """Where a joint was measured last before each next step, and at the end."""
    found: list[float] = []
    position = None
    for frame in walk:
        if frame.name == f"{joint}_STATUS":
            position = frame.signals["Position"]
        elif frame.name == f"{joint}_COMMAND" and frame.signals["NewSetPoint"]:
            found.append(position or 0.0)
    return [*found[1:], position or 0.0]
