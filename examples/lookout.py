"""A head looks left and right every half minute; test_lookout.py tests ten minutes of it without a robot."""

import threading

from trade import Container, errors, where

LEFT, RIGHT = [0.5, 0.0], [-0.5, 0.0]
PAUSE_S = 30.0


class Lookout:
    def __init__(self, container: Container) -> None:
        self._robot = container
        self._look = container.find(where(name="move_to", group="rosie.head", kind="JointGroup"), wait_s=10.0)
        self.ended = threading.Event()
        self.problem = ""
        """Why it did not look the last time; empty if it did."""

    def run(self) -> None:
        """Look left and right until `ended` is set."""
        goal, following = LEFT, RIGHT
        while not self.ended.wait(PAUSE_S):
            self.problem = self._try(goal)
            goal, following = following, goal

    def _try(self, goal: list[float]) -> str:
        try:
            with self._robot.lock("rosie.head", purpose="lookout", wait_s=1.0):
                self._look(goal)
        except errors.DeviceError as failed:  # it enables nothing: a person has to look first
            return str(failed)
        return ""
