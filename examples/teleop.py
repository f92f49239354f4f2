"""Teleoperation: a follower goes where a leader is moved to by hand.

Each in a terminal of its own; the first one says where the simulator's control socket is:

    trade up examples/teleop.toml --sim
    python examples/teleop.py                                   until Ctrl-C
    python examples/teleop.py hand /tmp/trade-sim-k2j/_control  plays the hand that moves the simulated leader
"""

import math
import sys
import threading
import time
from typing import Any

import trade
from trade import Handle, Settings, errors, where

LEADER, FOLLOWER = where(group="pair.leader"), where(group="pair.follower")
HZ = 50.0
VALID_S = 0.2
"""Validity of a set-point. Without a new one the driver stops the follower, even if this process dies."""
STALE_S = 1.0
"""Teleoperation ends after this time without a new set-point."""
NEAR_RAD = 0.05
SLOWLY_RAD_S = 0.3
TRIES = 3


def service(name: str, of: trade.Constraint) -> Handle:
    return trade.find(of & where(name=name, kind="JointGroup"), wait_s=10)


def say(text: str) -> None:
    print(f"teleop: {text}", flush=True)


class Teleoperation:
    """A leader and a follower, whose joints are in the same order."""

    def __init__(self) -> None:
        self.leader = service("state", LEADER)
        self.state, self.move_to, self.stop = (service(name, FOLLOWER) for name in ("state", "move_to", "stop"))
        self.servo = service("servo", FOLLOWER).with_(deadline_s=STALE_S)
        self.limits = service("limits", FOLLOWER)()

    def place(self, leader: list[Any]) -> list[float]:
        """Where the follower should be: where the leader is, within the follower's own limits."""
        joints = zip(leader, self.limits, strict=True)
        return [min(max(joint.position_rad, limit.min_rad), limit.max_rad) for joint, limit in joints]

    def run(self) -> None:
        """Follow until something ends it; then hold."""
        with trade.lock(LEADER | FOLLOWER, purpose="teleoperation"):
            if holding := [joint.name for joint in self.leader() if joint.enabled]:
                sys.exit(f"teleop: {', '.join(holding)} cannot be moved by hand: trade call pair.leader.arm.relax")
            try:
                self.approach()
                say("following; move the leader")
                self.follow()
            except (errors.LockLost, errors.MotionStopped, errors.Stopped):
                raise  # the follower has stopped; a stop now could hit its new owner
            except BaseException:
                self.stop()
                say("the follower holds")
                raise

    def approach(self) -> None:
        """Announce and make a slow move to the leader's pose, unless the follower is near it."""
        for _ in range(TRIES):
            place = self.place(self.leader())
            offs = {joint.name: there - joint.position_rad for joint, there in zip(self.state(), place, strict=True)}
            name = max(offs, key=lambda joint: abs(offs[joint]))
            far_rad = abs(offs[name])
            if far_rad <= NEAR_RAD:
                return
            say(f"{name} is {offs[name]:+.2f} rad away from the leader; going there at {SLOWLY_RAD_S} rad/s")
            self.move_to.with_(deadline_s=10 + far_rad / SLOWLY_RAD_S)(place, SLOWLY_RAD_S)
        sys.exit("teleop: the leader does not keep still")

    def follow(self) -> None:
        """Send the leader's newest position as a set-point.

        A short gap stops the follower until the next sample. A gap longer than ``STALE_S`` ends teleoperation.
        """
        with trade.stream(self.leader, hz=HZ, keep=1) as states:
            sent_s = time.monotonic()
            while True:
                try:
                    self.servo(self.place(states.next(VALID_S).value), VALID_S)
                    sent_s = time.monotonic()
                except TimeoutError:
                    if time.monotonic() - sent_s > STALE_S:
                        raise


def hand(control: str) -> None:
    """Move the simulated leader to and fro, all joints at the same time, then let go."""
    from trade_hil_sim import SimControl  # noqa: PLC0415 - nothing else here needs the simulator

    swings_rad, steps, centre, counts_a_rad = (0.6, -0.4, 0.5, 0.4, -0.6, 0.3), 200, 2048, 4096 / math.tau
    with SimControl(control) as simulator:
        for step in range(1, steps + 1):
            share = math.sin(math.pi * step / steps) ** 2
            for number, swing_rad in enumerate(swings_rad, 1):
                simulator.place(round(centre + share * swing_rad * counts_a_rad), [number], bus="leader")
            threading.Event().wait(0.04)
    print("hand: let go", flush=True)


def teleoperate() -> None:
    trade.start(Settings.read(container="teleop"))
    try:
        Teleoperation().run()
    except KeyboardInterrupt:
        say("ended")
    except (errors.TradeError, TimeoutError) as failed:
        sys.exit(f"teleop: ended: {type(failed).__name__}: {failed}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case []:
            teleoperate()
        case ["hand", control]:
            hand(control)
        case _:
            sys.exit(__doc__)
