"""Motion rules through the whole stack: a caller here, the driver in its own process, simulated servos in a third."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.conftest import Bench, Program
from trade import Handle, where
from trade.errors import ContainerLost, DeadlineExceeded, DeviceSilent, MotionStopped, OutcomeUnknown
from trade_hil_sim import events, motion_writes, received, writes


@pytest.fixture
def look(bench: Bench) -> Handle:
    return trade.find(where(name="move_to", group="rosie.head"), wait_s=30)


def test_S01_a_frozen_driver_never_writes_what_has_expired(bench: Bench, look: Handle) -> None:
    look([0.0, 0.0])
    bench.driver.signal(signal.SIGSTOP)
    frozen_at = time.monotonic()
    try:
        with pytest.raises((OutcomeUnknown, ContainerLost, DeadlineExceeded)):
            look.with_(deadline_s=0.5)([0.5, 0.0])
        wait_until(lambda: time.monotonic() > frozen_at + 1.5)
    finally:
        bench.driver.signal(signal.SIGCONT)
    state = trade.find(where(name="state", group="rosie.head"), wait_s=30)
    wait_until(lambda: _answers(state))  # the bus runs again, so what came before has been seen
    assert writes(bench.sim.entries(), since=frozen_at, register="goal_position") == []
    assert bench.rests("neck.pan") == []


def _answers(state: Handle) -> bool:
    try:
        state()
    except DeviceSilent:  # its newest measurement is from before
        return False
    return True


def test_S04_a_move_that_meets_its_deadline_is_reported_as_stopped(bench: Bench, look: Handle) -> None:
    look([0.0, 0.0])
    reported: list[type[Exception]] = []
    for goal in (1.2, -1.2, 1.2, -1.2, 1.2):  # a busy computer may be late now and then
        with pytest.raises((MotionStopped, OutcomeUnknown)) as ended:
            look.with_(deadline_s=1.0)([goal, 0.0], speed_rad_s=0.1)
        reported.append(ended.type)
        if ended.type is MotionStopped:
            assert "its call reached its deadline" in str(ended.value)
            break
    assert reported[-1] is MotionStopped
    wait_until(lambda: not bench.moving())
    assert abs(bench.rests("neck.pan")[-1]) < 1.0


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_S06_a_driver_that_dies_or_freezes_leaves_no_motion(number: int, bench: Bench, look: Handle) -> None:
    run = look.with_(deadline_s=120).start([1.3, 0.0], speed_rad_s=0.05)
    wait_until(bench.moving)
    bench.driver.signal(number)
    try:
        wait_until(lambda: not bench.moving())
        [rest] = bench.rests("neck.pan")
        assert 0.0 < rest < 1.0
        assert [entry.joint for entry in events(bench.sim.entries(), "watchdog_expired")]
        with pytest.raises(ContainerLost):
            run.result()
    finally:
        if number == signal.SIGSTOP:
            bench.driver.signal(signal.SIGCONT)
            os.kill(bench.driver.process.pid, signal.SIGTERM)


def test_S20_a_second_robot_on_the_port_is_refused_and_sends_nothing(
    bench: Bench, look: Handle, run: Callable[..., Program], tmp_path: Path
) -> None:
    bench.driver.signal(signal.SIGSTOP)  # what the log shows from now on is not the first driver's
    try:
        time_of_stop = time.monotonic()
        second = run("-m", "trade_gateway", "up", tmp_path / "head.toml", "--name", "second", "--json")
        assert second.wait() == 1
        assert "neck" in "".join(second.errors)
        heard = received(bench.sim.entries(), since=time_of_stop + 0.1)
    finally:
        bench.driver.signal(signal.SIGCONT)
    assert heard == b""


def test_S21_another_system_on_this_host_sees_nothing_and_moves_nothing(
    bench: Bench, look: Handle, trade_command: Callable[..., object]
) -> None:
    called = trade_command("--system", "another", "call", "rosie.head.move_to", "[0.3, 0.0]", "--wait", "1")
    assert called.returncode == 3
    assert "NoSuchService" in called.stderr
    assert motion_writes(bench.sim.entries()) == []


def test_S21_a_driver_listens_on_the_loopback_interface_only(bench: Bench) -> None:
    listening = [
        connection.laddr.ip
        for connection in psutil.Process(bench.driver.process.pid).net_connections(kind="inet")
        if connection.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)
    ]
    assert listening
    assert set(listening) == {"127.0.0.1"}


def test_S22_a_refused_command_is_typed_on_this_side_and_writes_no_byte(bench: Bench, look: Handle) -> None:
    with pytest.raises(trade.errors.LimitExceeded) as refused:
        look([0.1, 0.7])
    assert (refused.value.what, refused.value.upper, refused.value.unit) == ("rosie.neck.tilt", 0.6, "rad")
    with pytest.raises(trade.errors.InvalidArgument):
        look([0.1, float("nan")])
    assert motion_writes(bench.sim.entries()) == []
