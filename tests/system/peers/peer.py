"""A container for `trade conformance` in Python; with a rule's name it breaks that rule, so that its check fails."""

import math
import signal
import sys
import threading
import time
from typing import Any

from broken import BREAK

import trade
from trade import Handle, Resource, current_call, permit, service
from trade.errors import LimitExceeded, MotionStopped

SPEED_RAD_S = 1.0
MOST_RAD = 60.0
_TICK_S = 0.005


class Arm:
    """A simulated joint that turns at 1 rad/s."""

    def __init__(self) -> None:
        self.resources = [Resource("peer.arm")]
        self._angle_rad = 0.0
        self._began = 0
        self._turning: object = None
        self._lock = threading.Lock()

    @service(effect="read")
    def echo(self, value: Any) -> Any:
        """The same again."""
        return value

    @service(effect="read")
    def angle(self) -> float:
        """Its position, in rad."""
        return self._angle_rad

    @service(effect="read")
    def turns(self) -> int:
        """How many turns have begun."""
        return self._began

    @service
    def turn(self, angle_rad: float) -> float:
        """Go there; returns the angle on arrival."""
        if not abs(angle_rad) <= MOST_RAD:
            raise LimitExceeded(what="angle_rad", value=angle_rad, lower=-MOST_RAD, upper=MOST_RAD, unit="rad")
        call = current_call()
        with permit(self.resources) as permitted:
            me = object()
            with self._lock:
                self._began += 1
                self._turning = me
            self.resources[0].moving = True
            try:
                while self._angle_rad != angle_rad:
                    time.sleep(_TICK_S)
                    permitted.gate()
                    if call is not None:
                        call.raise_if_cancelled()
                    with self._lock:
                        if self._turning is not me:
                            raise MotionStopped(device="peer.arm", reason="it was halted, or turned elsewhere")
                        left_rad = angle_rad - self._angle_rad
                        step_rad = math.copysign(min(SPEED_RAD_S * _TICK_S, abs(left_rad)), left_rad)
                        at_goal = abs(left_rad) <= SPEED_RAD_S * _TICK_S
                        self._angle_rad = angle_rad if at_goal else self._angle_rad + step_rad
            finally:
                with self._lock:
                    if self._turning is me:
                        self._turning = None
                        self.resources[0].moving = False
        return self._angle_rad

    @service(effect="stop")
    def halt(self) -> None:
        """Stand still."""
        with self._lock:
            self._turning = None
            self.resources[0].moving = False


class Relay:
    """Calls others for any client."""

    @service
    def relay(self, service: Handle, resources: list[str], args: list[Any]) -> Any:
        """Call a service of another container, under a lock of these resources of it if there are any."""
        if not resources:
            return service(*args)
        using = [
            one for one in trade.services() if set(resources) & set(one.record.info.uses) and one.effect == "actuate"
        ]
        with trade.lock(using, purpose="relay", wait_s=0.0):
            return service(*args)


def main() -> None:
    """Offer both until SIGTERM."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    if len(sys.argv) > 1:
        BREAK[sys.argv[1]]()
    trade.register(Arm(), "peer")
    trade.register(Relay(), "peer")
    while not ended.wait(1.0):
        pass
    trade.close()


if __name__ == "__main__":
    main()
