"""A joint group across several buses, whose joints start, arrive and stop together.

It is vendor-neutral: each of its parts is a group of the joints that share a bus.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import copy_context
from typing import Final, TypeVar

from trade import Resource, current_call, permit
from trade.errors import TradeError
from trade_drivers._validation import finite, one_each, valid, within
from trade_drivers.interfaces._motion import JointGroup, MotorState
from trade_drivers.interfaces._trajectory import checked
from trade_drivers.motion._plan import JointLimits, Plan, Tolerances, Track
from trade_drivers.motion._spline import JointTask, there_together

_Result = TypeVar("_Result")
_LEAST_RAD_S: Final = 1e-3
_TOLERANCES: Final = Tolerances(start_rad=0.3, path_rad=0.3, goal_rad=0.035, goal_time_s=1.0)
"""Tolerances of a move: its start is a recent measurement, and the joints may already be moving."""


class AcrossGroup(JointGroup):
    """A group of joints on several buses of one process.

    Args:
        joints: their full names, in the order of all values.
        parts: one group for each bus; together they have exactly these joints.
    """

    def __init__(self, joints: Sequence[str], parts: Sequence[JointGroup]) -> None:
        self._joints = list(joints)
        self._parts = [(part, part.joints()) for part in parts]
        resources = {resource.name: resource for part in parts for resource in part.resources}
        self._resources = tuple(resources[joint] for joint in joints)

    @property
    def resources(self) -> tuple[Resource, ...]:
        return self._resources

    def joints(self) -> list[str]:
        return list(self._joints)

    def state(self) -> list[MotorState]:
        found = {state.name: state for part, _ in self._parts for state in part.state()}
        return [found[joint] for joint in self._joints]

    def limits(self) -> list[JointLimits]:
        found = {limits.name: limits for part, _ in self._parts for limits in part.limits()}
        return [found[joint] for joint in self._joints]

    def move_to(self, positions_rad: list[float], speed_rad_s: float | None = None) -> list[float]:
        limits = self.limits()
        goals = self._goals(positions_rad, limits, _service("move_to"))
        speeds = [limit.max_speed_rad_s for limit in limits]
        if speed_rad_s is not None:
            most = finite(speed_rad_s, _service("move_to"), "speed_rad_s")
            speeds = [
                within(most, _LEAST_RAD_S, limit.max_speed_rad_s, f"{limit.name} speed", "rad/s") for limit in limits
            ]
        ways = [
            JointTask(
                state.position_rad, state.velocity_rad_s if state.moving else 0.0, goal, speed, limit.max_accel_rad_s2
            )
            for state, goal, speed, limit in zip(self.state(), goals, speeds, limits, strict=True)
        ]
        curves = there_together(ways)
        return self.stream(checked([Track(*track) for track in zip(limits, curves, strict=True)], _TOLERANCES))

    def servo(self, positions_rad: list[float], valid_s: float = 0.2) -> None:
        service = _service("servo")
        goals = dict(zip(self._joints, self._goals(positions_rad, self.limits(), service), strict=True))
        valid(valid_s, service)
        with permit(self.resources):
            try:
                self._all(lambda part, joints: part.servo([goals[joint] for joint in joints], valid_s))
            except BaseException:
                with suppress(TradeError):  # the caller gets the original error, whether or not the stop succeeds
                    self.stop()
                raise

    def stream(self, plan: Plan) -> list[float]:
        plan.course.split(len(self._parts))

        def follow(part: JointGroup, joints: list[str]) -> dict[str, float]:
            try:
                return dict(zip(joints, part.stream(plan.of(joints)), strict=True))
            except BaseException as error:
                plan.course.fail(error)
                raise

        try:
            ended = {joint: angle for part in self._all(follow) for joint, angle in part.items()}
        except TradeError as error:
            raise plan.course.failed or error from None  # the first failure, not the first report
        return [ended[joint] for joint in self._joints]

    def stop(self) -> None:
        self._all(lambda part, _: part.stop())

    def enable(self) -> None:
        self._all(lambda part, _: part.enable())

    def relax(self) -> None:
        self._all(lambda part, _: part.relax())

    def _goals(self, positions_rad: Sequence[float], limits: Sequence[JointLimits], service: str) -> list[float]:
        values = one_each(positions_rad, self._joints, service, "positions_rad")
        return [
            within(value, limit.min_rad, limit.max_rad, limit.name, "rad")
            for value, limit in zip(values, limits, strict=True)
        ]

    def _all(self, act: Callable[[JointGroup, list[str]], _Result]) -> list[_Result]:
        """Runs an action on all buses at the same time and waits for all; the first error counts."""
        results: list[_Result] = []
        errors: list[BaseException] = []

        def one(part: JointGroup, joints: list[str]) -> None:
            try:
                results.append(act(part, joints))
            except BaseException as error:  # noqa: BLE001 - raised below, on the thread of the call
                errors.append(error)

        threads = [
            threading.Thread(target=copy_context().run, args=(one, *part), name=f"bus of {part[1][0]}", daemon=True)
            for part in self._parts
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise next((error for error in errors if isinstance(error, TradeError)), errors[0])
        return results


def _service(name: str) -> str:
    call = current_call()
    return name if call is None else call.service
