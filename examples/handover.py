"""A left arm hands an object to the right arm, which has a gripper; test_handover.py tests it without a robot."""

import trade
from trade import Container, Sample, service
from trade_drivers import Arm, Gripper

GIVE = [0.5, -1.0, 1.0, -1.5, -1.5, 0.0]
TAKE = [-0.5, -1.0, 1.0, -1.5, 1.5, 0.0]


class Handover:
    def __init__(self, container: Container) -> None:
        self._robot = container
        self.seen = 0

    def _see(self, sample: Sample) -> None:
        self.seen = sample.number

    @service
    def handover(self) -> float:
        """Hand the object over; returns the width that the gripper holds, in m."""
        left, right = (self._robot.find(Arm, group=f"rosie.{side}.arm") for side in ("left", "right"))
        hand = self._robot.find(Gripper, group="rosie.right.hand")
        held = self._robot.lock("rosie", purpose="handover", wait_s=0.5)
        with held, self._robot.stream("rosie.left.arm.state", hz=50, call=self._see):
            left.move_joints(GIVE)
            trade.progress("left arm there")
            right.move_joints(TAKE)
            trade.progress("right arm there")
            hand.close()
            return hand.state().width_m
