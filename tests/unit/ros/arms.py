"""Joints of TRADE without hardware: their commands are recorded, and they are at once where they should go."""

import threading
from typing import Any

from tests.support.waiting import wait_until
from trade import Resource, current_call, service
from trade_drivers import JointGroup, JointLimits, MotorState


class FakeJoints(JointGroup):
    """Of any number of joints; ``hold`` keeps a trajectory on its way until it is stopped."""

    def __init__(self, *names: str) -> None:
        self.names = names
        self._resources = tuple(Resource(name) for name in names)
        self.at = [0.0] * len(names)
        self.plans: list[Any] = []
        self.hold = False
        self.goes = threading.Event()
        self.stopped = threading.Event()
        self.error: Exception | None = None
        self.silent = False

    @property
    def resources(self) -> tuple[Resource, ...]:
        return self._resources

    @service(effect="read")
    def joints(self) -> list[str]:
        return list(self.names)

    @service(effect="read")
    def state(self) -> list[MotorState]:
        if self.silent:
            raise RuntimeError("nothing was heard of them")
        return [
            MotorState(
                name=name,
                position_rad=angle,
                velocity_rad_s=0.5,
                load=0.0,
                temperature_c=None,
                voltage_v=None,
                enabled=True,
                moving=False,
                measured_at=0.0,
                age_s=0.25,
            )
            for name, angle in zip(self.names, self.at, strict=True)
        ]

    @service(effect="read")
    def limits(self) -> list[JointLimits]:
        return [
            JointLimits(name=name, min_rad=-2.0, max_rad=2.0, max_speed_rad_s=3.0, max_accel_rad_s2=30.0)
            for name in self.names
        ]

    @service
    def move_to(self, positions_rad: list[float], speed_rad_s: float | None = None) -> list[float]:
        self.at = positions_rad
        return positions_rad

    @service
    def servo(self, positions_rad: list[float], valid_s: float = 0.2) -> None:
        self.at = positions_rad

    def stream(self, plan: Any) -> list[float]:
        self.plans.append(plan)
        self.stopped.clear()
        for resource in self._resources:
            resource.moving = True
        self.goes.set()
        call = current_call()
        if self.hold:
            wait_until(lambda: self.stopped.is_set() or (call is not None and call.cancelled))
        for resource in self._resources:
            resource.moving = False
        if call is not None and call.cancelled:
            self.stop()  # as a driver does: who cancels first leaves nothing to stop for who comes second
            call.raise_if_cancelled()
        if self.error is not None:
            raise self.error
        self.at = [track.curve.at(1e9)[0] for track in plan.tracks]
        return self.at

    @service(effect="stop")
    def stop(self) -> None:
        for resource in self._resources:
            resource.moving = False
        self.stopped.set()

    @service
    def enable(self) -> None: ...

    @service
    def relax(self) -> None: ...
