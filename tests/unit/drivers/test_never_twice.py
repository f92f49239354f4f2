"""S20 on CAN buses: a second driver sends nothing at all, whether the host knows the first one or it is only heard."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HIP, PATIENT, Leg
from tests.unit.drivers.motor_rig import KINDS, ROOT
from trade.errors import ConfigurationError
from trade_drivers import Commissioner, Motor, scan
from trade_drivers.vendors.cia402 import Cia402Driver
from trade_drivers.vendors.damiao import DamiaoDriver
from trade_drivers.vendors.odrive import OdriveDriver

pytestmark = pytest.mark.virtual_time

RIGS: dict[str, type[Leg]] = {"cia402": Leg, **KINDS}
COMMISSIONERS: dict[str, Callable[[], Commissioner]] = {
    "cia402": Cia402Driver.commissioner,
    "damiao": DamiaoDriver.commissioner,
    "odrive": OdriveDriver.commissioner,
}
JOINTS = {"cia402": ("leg.hip", HIP), "damiao": ("tail.root", ROOT), "odrive": ("tail.root", ROOT)}


class CanRig:
    """A simulated bus of one kind, and the driver that has it."""

    def __init__(self, kind: str, undo: ExitStack) -> None:
        self.kind, self.rig = kind, RIGS[kind](undo)
        if kind == "cia402":
            self.rig.configure(PATIENT)
        self.rig.plug()
        self.joint, self.id = JOINTS[kind]

    def attach(self, port: str = "") -> Motor:
        bus = self.rig.robot.buses[0].name
        return self.rig.attach(ports={bus: port or self.rig.sim.port}).motor(self.joint)

    @property
    def elsewhere(self) -> str:
        """The bus, as reached by a client that this host does not know: by another address."""
        return self.rig.sim.port.replace("127.0.0.1", "localhost")

    def senders(self, since: float = 0.0) -> set[str]:
        """The clients of the bus that have sent anything."""
        return {frame.source for frame in self.rig.frames(since=since) if frame.source.startswith("client")}


@pytest.fixture(params=list(RIGS))
def bus(request: pytest.FixtureRequest) -> Iterator[CanRig]:
    with ExitStack() as undo:
        yield CanRig(request.param, undo)


@pytest.mark.parametrize("known", [True, False], ids=["known", "heard"])
def test_S20_a_second_driver_on_a_can_bus_sends_nothing_and_the_firsts_move_arrives(bus: CanRig, known: bool) -> None:
    motor, port = bus.attach(), "" if known else bus.elsewhere
    motor.enable()
    [first] = bus.senders()
    mark = written_now()
    moving = Outcome(lambda: motor.move_to(0.9, 0.5))
    bus.rig.wait_for("motion_started", bus.id, mark)
    with pytest.raises(ConfigurationError, match="another driver") as refused:
        bus.attach(port)
    assert "stop it first" in str(refused.value)
    assert bus.senders() == {first}
    assert moving.wait().result == pytest.approx(0.9, abs=0.01)
    motor.relax()
    with pytest.raises(ConfigurationError, match="another driver"):
        bus.attach(port)
    assert bus.senders() == {first}


@pytest.mark.parametrize("known", [True, False], ids=["known", "heard"])
def test_S20_a_scan_of_a_can_bus_that_has_a_driver_sends_nothing(bus: CanRig, known: bool) -> None:
    bus.attach()
    [first] = bus.senders()
    with pytest.raises(ConfigurationError, match="another driver"):
        scan(COMMISSIONERS[bus.kind](), bus.rig.sim.port if known else bus.elsewhere)
    assert bus.senders() == {first}


def test_S20_a_can_bus_is_free_again_once_its_driver_has_left(bus: CanRig) -> None:
    for _ in range(2):
        bus.rig.attach(ports={bus.rig.robot.buses[0].name: bus.rig.sim.port}).close()
