"""What naive code makes of ends and beginnings of motion. Each changes one function."""

from collections.abc import Callable, Generator, Iterator
from typing import Any

import pytest

from trade._estop.deadman import Deadman
from trade_drivers.bus._thread import BusThread
from trade_drivers.joints import Axis, Exchange, Motion, Ramp
from trade_drivers.joints._jobs import Enable
from trade_drivers.joints._setpoint import SetPoint
from trade_drivers.joints._zero import Zero
from trade_drivers.joints.serial import ServoAxis
from trade_drivers.vendors.cia402._exchange import DriveExchange
from trade_drivers.vendors.damiao._exchange import DamiaoExchange
from trade_drivers.vendors.dynamixel import _table as dynamixel
from trade_drivers.vendors.dynamixel._exchange import DynamixelExchange
from trade_drivers.vendors.feetech import _table as feetech
from trade_drivers.vendors.feetech._exchange import FeetechExchange


def a_driver_that_leaves_relaxes(patch: pytest.MonkeyPatch) -> None:
    leave = Exchange.leave
    patch.setattr(Exchange, "leave", lambda self, alive, *, relax: leave(self, alive, relax=True))


def enabling_wants_no_fault(patch: pytest.MonkeyPatch) -> None:
    steps = Enable.steps

    def strict(self: Enable) -> Iterator[None]:
        for axis in self.devices:
            if axis.fault:
                raise axis.fault_error()
        yield from steps(self)

    patch.setattr(Enable, "steps", strict)


def enabling_restarts_no_servo(patch: pytest.MonkeyPatch) -> None:
    def as_it_is(bus: Any, job: Any, axis: Any) -> Generator[None, None, Any]:
        yield
        return axis.health

    patch.setattr(DynamixelExchange, "_restart", as_it_is)


def enabling_resets_no_fault_of_a_drive(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(DriveExchange, "_reset", lambda *_: iter(()))


def the_end_of_a_session_stops_nothing(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Deadman, "session_ended", lambda self, session: None)


def the_last_speed_holds_without_end(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(SetPoint, "watch", lambda self, now_ns: None)


def _torque_alone(register: Any) -> Callable[..., Iterator[None]]:
    def enabling(bus: Any, job: Any, axis: Any) -> Iterator[None]:
        yield from bus.write_register(job, axis, register, 1)
        axis.fault, axis.ready = "", True

    return enabling


def enabling_a_dynamixel_writes_torque_alone(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(DynamixelExchange, "enabling", _torque_alone(dynamixel.TORQUE_ENABLE))


def enabling_a_feetech_writes_torque_alone(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(FeetechExchange, "enabling", _torque_alone(feetech.TORQUE))


def a_course_begins_at_zero(patch: pytest.MonkeyPatch) -> None:
    def stand(self: DamiaoExchange, axis: Any) -> None:
        accel = float(axis.accel_counts)
        axis.course = Ramp(0, fastest=axis.speed_counts, accel=accel, braking=accel)

    patch.setattr(DamiaoExchange, "stand", stand)


def a_port_that_was_lost_is_not_opened_again(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(BusThread, "_reopen", lambda self: self.exchange.fail_all(self._gone))


def two_motions_have_one_joint(patch: pytest.MonkeyPatch) -> None:
    def take_over(self: Exchange, motion: Motion) -> None:
        motion.attended_ns = self.lasting_clock()
        for axis in motion.devices:
            axis.motion, axis.still, axis.halting_since_ns = motion, 0, 0

    patch.setattr(Exchange, "take_over", take_over)


def a_joint_outside_its_limits_is_refused(patch: pytest.MonkeyPatch) -> None:
    check_usable = Axis.check_usable

    def strict(self: Axis, now_ns: int, stale_after_ns: int) -> Any:
        sample = check_usable(self, now_ns, stale_after_ns)
        self.check_goal(sample.position)
        return sample

    patch.setattr(Axis, "check_usable", strict)


def a_servo_may_be_enabled_anywhere(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(ServoAxis, "outside", lambda self, position: "")


def an_angle_after_a_loss_of_power_is_believed(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Zero, "doubt", lambda _, __: "")
