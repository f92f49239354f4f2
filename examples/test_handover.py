import pytest
from handover import Handover

from trade.errors import Cancelled, LockedByOther
from trade.testing import MemorySystem
from trade_drivers.testing import FakeArm, FakeGripper


class Rosie:
    def __init__(self, system: MemorySystem) -> None:
        self.left, self.right = FakeArm("rosie.left.arm"), FakeArm("rosie.right.arm")
        self.hand = FakeGripper("rosie.right.hand")
        self.hand.activate()
        self.hand.object_width_m = 0.04
        for device in (self.left, self.right, self.hand):
            system.container("robot").register(device, device.name)
        self.mind = system.container("mind")
        self.mind.register(Handover(self.mind), "rosie.skills")


@pytest.fixture
def rosie(trade_system: MemorySystem) -> Rosie:
    return Rosie(trade_system)


def test_the_object_changes_hands(rosie: Rosie) -> None:
    run = rosie.mind.find("rosie.skills.handover").start()
    assert run.result(10) == pytest.approx(0.04, abs=0.001)
    assert run.progress() == "right arm there"
    assert (len(rosie.left.went), len(rosie.right.went)) == (1, 1)


def test_an_arm_that_another_client_holds_is_not_moved(rosie: Rosie, trade_system: MemorySystem) -> None:
    with trade_system.container("other").lock("rosie.right.arm"), pytest.raises(LockedByOther):
        rosie.mind.call("rosie.skills.handover")
    assert rosie.left.went == rosie.right.went == []


def test_after_a_cancellation_nothing_more_moves(rosie: Rosie) -> None:
    rosie.right.arrives.clear()
    run = rosie.mind.find("rosie.skills.handover").start()
    run.on_progress(lambda _: run.cancel())
    with pytest.raises(Cancelled):
        run.result(10)
    assert (len(rosie.left.went), rosie.right.went, rosie.mind.locks()) == (1, [], [])
