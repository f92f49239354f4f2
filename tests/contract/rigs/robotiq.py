"""The gripper 2F-85 on Modbus."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, ClassVar

import pytest

from tests.contract.rigs.base import DriverProcess, SafetyRig
from tests.support.simulated_robots import HAND
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome
from tests.unit.drivers.gripper_rig import HandRig, silent
from trade import Container
from trade.errors import DeviceError
from trade_hil_sim import LogEntry, Mute, WrongModel, events

_SLOW_M_S = 0.02
_OPEN_M = 0.085
_ONE_DEVICE = "there is one gripper on its line"
_NO_SET_POINT = "a gripper follows no set-points"
_NO_JOINT = "a gripper has no joint"


class RobotiqRig(SafetyRig):
    """A hand; its fingers begin open."""

    vendor, column = "robotiq", "2F-85"
    library, importing = ("pymodbus", "pymodbus"), ("vendors.robotiq._wire",)
    resource = "rosie.left.hand"
    far, slowly, readying = ("close",), ("close", _SLOW_M_S), ("activate",)
    stops_without_driver = False
    swapped, says_model = WrongModel(number=0), "gripper.\"left.hand\": what answers on bus 'hand' is no 2F-85"
    lost = (Mute(count=1),)
    says_absent = ('gripper."left.hand": no gripper answers to id 9',)
    lacks: ClassVar = {
        "test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why": "the move has ended by then: the device "
        "has no watchdog",
        "test_S06_every_enabled_joint_has_its_watchdog_armed": "the device has no watchdog",
        "test_S07_a_stop_gets_through_while_another_joint_is_silent": _ONE_DEVICE,
        "test_S08_a_stop_halts_every_joint_of_a_group_that_moves": _ONE_DEVICE,
        "test_S11_a_set_point_ends_with_the_lock_it_was_admitted_under": _NO_SET_POINT,
        "test_S13_a_lock_is_granted_once_devices_that_still_move_are_at_rest": _NO_SET_POINT,
        "test_S16_a_group_with_a_missing_member_is_not_locked": _ONE_DEVICE,
        "test_S16_coupled_joints_are_locked_together": _ONE_DEVICE,
        "test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire": "it is judged in test_fences.py: "
        "a lock is broken while the command waits",
        "test_S18_enabling_aims_at_the_measured_position": _NO_JOINT,
        "test_S19_shutdown_holds_the_position_disarms_the_watchdog_and_moves_nothing": "it keeps what it holds: "
        "unit/drivers/test_robotiq_attached.py",
        "test_S19_shutdown_with_relax_switches_torque_off": "it keeps what it holds: "
        "unit/drivers/test_robotiq_attached.py",
        "test_S22_a_goal_outside_is_refused_with_its_limits": _NO_JOINT,
        "test_S22_the_ends_of_the_range_belong_to_it": _NO_JOINT,
        "test_S22_a_move_back_inside_is_allowed_from_outside": "fingers cannot be outside",
        "test_S22_a_profile_at_the_limits_is_followed_to_the_end_of_the_range": _NO_JOINT,
        "test_S22_the_bus_thread_looks_at_the_limits_itself": _NO_JOINT,
    }

    def on_the_bench(self) -> Any:
        return HandRig(self.folder, self.undo)

    def attach(self, **options: Any) -> None:
        self.plug()
        self.robot = self.bench.attach(**options)
        self.device = self.robot.gripper("left.hand")

    def attach_to_command(self, **options: Any) -> None:
        self.attach(**options)
        self.ready()

    def ready(self) -> None:
        self.device.activate()

    def commands(self) -> Iterable[Callable[[], object]]:
        return (self.move, self.device.close, self.device.open, self.device.activate, self.device.clear_fault)

    def queued(self) -> Iterable[Callable[[], object]]:
        return (self.move, self.device.close, self.device.open)

    def move(self) -> object:
        return self.device.move_to(0.02)

    def set_off(self) -> Outcome:
        if not self.device.state().activated:
            self.ready()
        moving = Outcome(lambda: self.device.close(_SLOW_M_S))
        self.bench.under_way()
        return moving

    def requests(self, container: Container) -> Iterable[Callable[[], object]]:
        for request in (("close",), ("open",), ("move_to", 0.05), ("activate",), ("clear_fault",)):
            yield partial(self.asked, container, request)

    def moves_back(self, container: Container) -> bool:
        return abs(self.asked(container, ("open",)).width_m - _OPEN_M) < 0.001

    def judge_ended(self) -> None:
        assert self.bench.truth.width_m > 0.03

    def under_way(self) -> None:
        self.bench.under_way()

    def outside(self) -> Iterable[Callable[[], object]]:
        for width, speed, force in (
            *((value, None, None) for value in (-0.001, 0.0851, math.nan, math.inf)),
            *((0.04, value, None) for value in (0.019, 0.151, 0.0, math.nan)),
            *((0.04, None, value) for value in (19.9, 200.1, 0.0, math.inf)),
        ):
            yield lambda asked=(width, speed, force): self.device.move_to(*asked)

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        return self.bench.writes(since)

    def sent_away(self, since: float, within_rad: float = 0.0) -> Sequence[object]:
        return self.bench.moves(since)

    @property
    def moving(self) -> bool:
        return bool(self.bench.truth.moving)

    def travelled(self) -> float:
        return 1 - float(self.bench.truth.width_m) / _OPEN_M

    def events(self, name: str, since: float) -> Sequence[LogEntry]:
        return events(self.bench.log, name, since=since)

    def driver_process(self) -> DriverProcess:
        self.plug()
        file = self.folder / "hand.toml"
        file.write_text(HAND, encoding="utf-8")
        made = DriverProcess("gripper_process.py", str(file), str(self.bench.sim.port))
        self.undo.callback(made.close)
        self.bench.wait_for("motion_started", self.bench.wait_for("activated").t)
        return made

    def last_resort(self, lost: float) -> None:
        """The fingers end the move that they were sent last, and begin no other."""
        self.bench.wait_for("at_rest", lost)
        assert self.bench.truth.width_m == pytest.approx(0.05, abs=0.001)
        assert not self.bench.moves(lost + 0.1)

    def falls_silent(self) -> float:
        [stop] = self.bench.writes(self.events("motion_started", 0.0)[-1].t)
        assert not stop.moves
        wait_until(lambda: silent(self.device), "what was measured is too old")
        with pytest.raises(DeviceError, match="not healthy"):
            self.device.state()
        return float(stop.t) + 0.1
