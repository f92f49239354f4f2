"""Arms of Universal Robots."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, ClassVar

import psutil

from tests.contract.rigs.base import DriverProcess, SafetyRig
from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import FAR, SLOW, ArmRig, answers
from tests.unit.drivers.attached_arm import ARM, AT_HOME
from tests.unit.drivers.conftest import Outcome, written_now
from trade import Container
from trade_hil_sim import Arm, LogEntry, events, instructions

_ONE_DEVICE = "an arm has a controller of its own"
_LIMITS = "unit/drivers/test_ur_way.py has the limits of arms"


class UrRig(SafetyRig):
    """A UR5e; its base is turned."""

    vendor, column = "ur", "UR"
    library = "ur-rtde", "rtde_control"
    resource = "ada.right"
    far, slowly, set_point = ("move_joints", FAR), ("move_joints", FAR, SLOW), ("servo", FAR, 1.0)
    drift = 0.83
    says_model = "has a UR10, not a UR5e"
    says_absent = ("arm.toml: bus.ur.host",)
    readying = ("freedrive", True)
    lacks: ClassVar = {
        "test_a_lost_answer_is_forgiven": "TCP repeats lost packets",
        "test_S01_a_plain_call_waits_one_second_for_its_turn_at_most": "if no process reads the controller's states "
        "for a second, the connection ends, and the call with it",
        "test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why": "its processes are frozen apart: "
        "unit/drivers/test_ur_safety.py suspends the host",
        "test_S06_every_enabled_joint_has_its_watchdog_armed": "the watchdog is armed by the process that "
        "commands, when it takes control; unit/drivers/test_ur_safety.py kills it",
        "test_S07_a_stop_gets_through_while_another_joint_is_silent": _ONE_DEVICE,
        "test_S08_a_stop_halts_every_joint_of_a_group_that_moves": _ONE_DEVICE,
        "test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire": "test_fences.py has a lock that is lost",
        "test_S16_a_group_with_a_missing_member_is_not_locked": _ONE_DEVICE,
        "test_S16_coupled_joints_are_locked_together": _ONE_DEVICE,
        "test_S18_enabling_aims_at_the_measured_position": "power and brakes are switched by request only",
        "test_S18_replugging_never_enables_and_never_commands": "unit/drivers/test_ur_attach.py: a controller "
        "that comes back is read and not commanded",
        "test_S19_shutdown_holds_the_position_disarms_the_watchdog_and_moves_nothing": "an arm always holds",
        "test_S19_shutdown_with_relax_switches_torque_off": "an arm always holds",
        "test_S20_a_second_driver_on_the_port_is_refused_and_sends_not_one_byte": "unit/drivers/test_ur_attach.py "
        "has two drivers of an arm",
        "test_S22_a_goal_outside_is_refused_with_its_limits": _LIMITS,
        "test_S22_the_ends_of_the_range_belong_to_it": _LIMITS,
        "test_S22_a_move_back_inside_is_allowed_from_outside": _LIMITS,
        "test_S22_a_profile_at_the_limits_is_followed_to_the_end_of_the_range": "the test beside it has an arm",
        "test_S22_the_bus_thread_looks_at_the_limits_itself": _LIMITS,
    }

    def on_the_bench(self) -> Any:
        return ArmRig(self.undo)

    def plug(self) -> None:
        """The controller answers."""

    def swap(self) -> None:
        self.bench = ArmRig(self.undo, Arm("UR10e", name="right"))

    def attach(self, **options: Any) -> None:
        self.robot = self.bench.attach(**options)
        self.device = self.bench.arm

    def ready(self) -> None:
        """Take control, which the first move does."""
        self.device.move_joints([0.05, *AT_HOME[1:]])

    def commands(self) -> Iterable[Callable[[], object]]:
        return (self.move, lambda: self.device.servo(FAR, 0.3), lambda: self.device.freedrive(True))

    def move(self) -> object:
        return self.device.move_joints(FAR)

    def set_off(self) -> Outcome:
        moving: Outcome = self.bench.set_off()
        return moving

    def requests(self, container: Container) -> Iterable[Callable[[], object]]:
        for request in (self.far, self.set_point, self.readying):
            yield partial(self.asked, container, request)

    def moves_back(self, container: Container) -> bool:
        return abs(self.asked(container, ("move_joints", AT_HOME))[0]) < 0.01

    def judge_ended(self) -> None:
        rested = written_now()
        wait_until(self._halts, "it is halted")  # it also rests when a set-point of a stream is late
        self.bench.comes_to_rest()
        ended = self._halts()
        wait_until(lambda: answers(self.device, rested + 0.5), "time has passed")
        assert not self.bench.moves(max(rested, ended[-1].t))

    def _halts(self) -> list[LogEntry]:
        return [*instructions(self.bench.log, "stop_j"), *instructions(self.bench.log, "servo_stop")]

    def under_way(self) -> None:
        wait_until(lambda: self.bench.base_rad > 0.05, "it is under way")

    def outside(self) -> Iterable[Callable[[], object]]:
        for value in (7.0, -7.0, 1e300, math.nan, math.inf):
            yield lambda value=value: self.device.move_joints([value, *AT_HOME[1:]])
            yield lambda value=value: self.device.servo([value, *AT_HOME[1:]], 0.3)
        for speed in (0.0, -1.0, 100.0, math.nan):
            yield lambda speed=speed: self.device.move_joints(FAR, speed)

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        return self.bench.moves(since)

    def sent_away(self, since: float, within_rad: float = 0.0) -> Sequence[object]:
        return self.bench.moves(since)

    @property
    def moving(self) -> bool:
        return bool(self.bench.moving)

    def travelled(self) -> float:
        return float(self.bench.base_rad) / FAR[0]

    def events(self, name: str, since: float) -> Sequence[LogEntry]:
        return events(self.bench.log, name, since=since)

    def driver_process(self) -> DriverProcess:
        file = self.folder / "arm.toml"
        file.write_text(ARM, encoding="utf-8")
        made = DriverProcess("arm_process.py", str(file), self.bench.sim.port, "move")

        def close() -> None:
            family = psutil.Process(made.process.pid).children()
            made.close()
            psutil.wait_procs(family, 20)

        self.undo.callback(close)
        return made

    def last_resort(self, lost: float) -> None:
        """The controller's RTDE watchdog ends the program, and the arm stops."""
        self.bench.comes_to_rest()
        wait_until(lambda: self.events("program_stopped", lost), "its program has ended")
        assert not self.bench.moves(self.events("program_stopped", lost)[0].t)

    def falls_silent(self) -> float:
        wait_until(lambda: self.bench.truth.program == "", "its program has ended")
        return max(entry.t for entry in self.bench.log)

    def heard(self, since: float) -> Sequence[LogEntry]:
        return [entry for entry in self.bench.moves(since) if entry.t > since]
