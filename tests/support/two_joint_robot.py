"""A robot in memory, each of its joints on a container of its own, and who uses them."""

import threading

from trade import Container, Handle, Resource, permit, service, where
from trade.errors import DeviceSilent
from trade.testing import MemorySystem

WHOLE = where(group="robot")
"""All of it."""


class Joint:
    """One joint: every write goes through the gate, as a driver's does."""

    def __init__(self, name: str = "joint") -> None:
        self.resource = Resource(name)
        self.resources = [self.resource]
        self.written: list[float] = []
        self.stopped = threading.Event()
        self.stop_fails = False
        self.hold = threading.Event()
        self.hold.set()
        self.entered = threading.Event()

    @service
    def move(self, value: float) -> float:
        with permit(self.resources) as permitted:
            self.entered.set()
            self.hold.wait(30)
            permitted.gate()
            self.written.append(value)
        return value

    @service
    def go_on(self, value: float) -> None:
        """Comes back at once and moves until it is stopped."""
        with permit(self.resources) as permitted:
            permitted.gate()
            self.resource.moving = True

    @service(effect="read")
    def where_is_it(self) -> float:
        return self.written[-1] if self.written else 0.0

    @service(effect="stop")
    def stop(self) -> None:
        if self.stop_fails:
            raise DeviceSilent(device=self.resource.name, bus="/dev/ttyX", waited_s=0.1)
        self.resource.moving = False
        self.stopped.set()


class Robot:
    """Joints ``a``, ``b``, ... each on a container of its own, and who uses them."""

    def __init__(self, system: MemorySystem, names: str = "ab") -> None:
        self.system = system
        self.me, self.other = system.container("me"), system.container("other")
        self.joints = {name: Joint(name) for name in names}
        for name, joint in self.joints.items():
            system.container(name).register(joint, f"robot.{name}")
        system.settle()

    def find(self, name: str, what: str = "move", whose: Container | None = None) -> Handle:
        return (whose or self.me).find(where(group=f"robot.{name}", name=what), wait_s=20)

    def __getitem__(self, name: str) -> Joint:
        return self.joints[name]
