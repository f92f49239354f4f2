"""A full send queue of a CAN interface: waited for, then named. Stops go out behind the frames before them."""

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import can
import pytest

from tests.contract.rigs.base import answers
from tests.support.can_queue import QueuedBus
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HIP, Leg
from tests.unit.drivers.motor_rig import KINDS
from tests.unit.drivers.test_can_state import answer, attribute
from trade.errors import BusGone, DeviceAbsent, DeviceFault, SendQueueFull, TradeError
from trade_drivers import AttachedRobot
from trade_drivers.bus._jobs import PortFull
from trade_drivers.bus.can import CanPort
from trade_drivers.bus.can._netlink import parse_link
from trade_hil_sim import Absent

pytestmark = pytest.mark.virtual_time

RIGS = {"cia402": Leg, **KINDS}
FRAME_S = 0.00013
"""Of a frame of 8 bytes at 1 Mbit/s."""


@pytest.fixture(autouse=True)
def offered() -> Iterator[None]:
    with QueuedBus.offered():
        yield


@pytest.fixture(params=list(RIGS))
def rig(request: pytest.FixtureRequest) -> Iterator[Leg]:
    with ExitStack() as undo:
        made = RIGS[request.param](undo)
        made.plug()
        yield made


def attached(rig: Leg) -> AttachedRobot:
    port = rig.sim.port.replace("socketcand", "queued")
    return rig.attach(ports={rig.robot.buses[0].name: port})


def enabled(rig: Leg) -> AttachedRobot:
    robot = attached(rig)
    for joint in rig.robot.joints:
        robot.motor(joint.name).enable()
    return robot


def refusal(act: Callable[[], object]) -> str:
    try:
        act()
    except TradeError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("length", [1, 128])
def test_commands_of_a_group_wait_for_room_in_a_short_queue(rig: Leg, length: int) -> None:
    QueuedBus.reset(length, FRAME_S)
    QueuedBus.full_every = 5 if length == 1 else 0
    robot = enabled(rig)
    group = robot.group(rig.robot.groups[0].name)
    for goal in (0.1, 0.0, 0.1):
        assert group.move_to([goal, goal]) == pytest.approx([goal, goal], abs=0.02)
    assert bool(QueuedBus.refused) == (length == 1)  # else the test shows nothing


def test_a_queue_that_stays_full_ends_a_move_with_its_name_and_nothing_moves_on_return(rig: Leg) -> None:
    robot = enabled(rig)
    motor = robot.motor(rig.robot.joints[0].name)
    moving = Outcome(lambda: motor.move_to(0.9, 0.2))
    began = rig.wait_for("motion_started", HIP).t
    lost = motor.state().measured_at
    QueuedBus.stuck = True
    error = moving.wait().error
    assert isinstance(error, SendQueueFull)
    assert isinstance(error, BusGone)  # what callers catch already
    assert "no frame can be sent on queued:" in str(error)
    assert "its send queue has been full for" in str(error)
    assert "nothing acknowledges its frames" in str(error)
    rig.wait_for("watchdog_expired", HIP, began)
    wait_until(lambda: not rig.truth(HIP).moving, "it rests")
    assert rig.truth(HIP).position_rad < 0.8
    mark = written_now()
    QueuedBus.stuck = False
    wait_until(lambda: answers(motor.state) and motor.state().measured_at > lost + 0.5, "it is heard again")
    with pytest.raises(DeviceFault):
        motor.move_to(0.0)
    assert not rig.events("motion_started", HIP, mark)
    motor.enable()
    assert motor.move_to(0.0) == pytest.approx(0.0, abs=0.02)


def test_S07_a_stop_that_meets_a_full_queue_goes_out_behind_the_frames_before_it(rig: Leg) -> None:
    QueuedBus.reset(2)
    robot = enabled(rig)
    motor = robot.motor(rig.robot.joints[0].name)
    moving = Outcome(lambda: motor.move_to(0.9, 0.2))
    wait_until(lambda: rig.truth(HIP).position_rad > 0.05, "it is under way")
    QueuedBus.full_for, QueuedBus.refused = 10, 0  # another program has filled it
    motor.stop()
    assert QueuedBus.refused >= 10  # it had to wait
    assert "stop() was called" in str(moving.wait().error)
    assert rig.truth(HIP).position_rad < 0.5
    assert motor.move_to(0.0) == pytest.approx(0.0, abs=0.02)  # the bus was never given up


def test_at_attach_a_queue_that_stays_full_is_an_absence_with_what_to_check(rig: Leg) -> None:
    QueuedBus.reset(1)
    QueuedBus.stuck = True
    with pytest.raises(
        DeviceAbsent, match=r"its send queue has been full for .* check the power of its devices"
    ) as why:
        attached(rig)
    assert "is the interface up" not in str(why.value)
    assert not rig.announced


def test_a_motor_that_is_missed_is_named_with_the_state_of_the_bus(rig: Leg) -> None:
    robot = attached(rig)
    motor = robot.motor(rig.robot.joints[0].name)
    QueuedBus.error = 0x020  # no acknowledgement
    rig.sim.do(Absent())
    wait_until(lambda: "the bus is error-active: nothing acknowledges frames" in refusal(motor.state), "it is said")
    robot.close()
    with pytest.raises(DeviceAbsent, match=r"answers as .*; the bus is error-active: nothing acknowledges frames"):
        attached(rig)


def test_a_port_that_hears_that_nothing_acknowledges_says_only_that() -> None:
    port = CanPort("virtual:test_send_queue", 1_000_000)
    port.open()
    with can.Bus(interface="virtual", channel="test_send_queue") as peer:
        for lost, said in ((False, "it is too short"), (True, "; nothing acknowledges its frames")):
            if lost:
                peer.send(can.Message(arbitration_id=0x020, data=bytes(8), is_error_frame=True))
                assert port.receive(1) is None
            assert said in str(port.queue.full(unheard=port.unheard))
        peer.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert port.receive(1) is not None
    assert not port.unheard
    port.close()


def test_a_socket_whose_own_buffer_is_full_is_a_full_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    port = CanPort("virtual:test_send_queue_2", 1_000_000)
    port.open()

    def full(*_: object, **__: object) -> None:
        raise can.CanOperationError("Transmit buffer full")  # as python-can says it

    monkeypatch.setattr(port._bus, "send", full)
    with pytest.raises(PortFull, match="full for 40 ms"):
        port.send(0x123, b"")
    port.close()


def test_the_length_of_the_queue_is_parsed_from_the_reply_of_the_kernel() -> None:
    assert parse_link(answer(1, attribute(13, struct.pack("=I", 10)))).queue == 10
    assert parse_link(answer(1)).queue is None
