"""The paper's scenario: two behaviours want one head, the second asks, the first lets go; then the second is killed."""

import signal
import time
from collections.abc import Callable
from pathlib import Path

from tests.support.waiting import wait_until
from tests.system.conftest import Program, Rosie
from trade import Container, where
from trade_hil_sim import events, read_log

BEHAVIOURS = Path(__file__).parents[2] / "examples" / "who_has_the_head.py"
HEAD = where(group="rosie.head")


def reported(program: Program, until: str) -> str:
    """The line of a behaviour that has these words."""
    while until not in (line := program.line()):
        assert line, f"it ended without saying {until!r}"
    return line


def test_navigation_asks_for_the_head_and_gets_it(
    rosie_up: Callable[[], Rosie], run: Callable[..., Program], start_container: Callable[..., Container]
) -> None:
    log = rosie_up().log
    onlooker = start_container("onlooker")
    onlooker.find(HEAD & where(name="move_to"), wait_s=60)
    finding = run(BEHAVIOURS, "find-target")
    reported(finding, "I have the head")
    [lock] = onlooker.locks()
    assert (lock.holder.container, lock.holder.purpose) == ("find-target", "finding a target")
    assert set(lock.resources) == {"rosie.neck.pan", "rosie.neck.tilt"}

    navigating = run(BEHAVIOURS, "navigate")
    assert "find-target has the head, for 'finding a target'" in reported(navigating, "has the head")
    assert "navigate asks for the head: there is something ahead of me" in reported(finding, "asks for the head")
    reported(finding, "I have let go")
    began = time.monotonic()
    reported(navigating, "I have the head")
    assert finding.wait() == 0, finding.errors
    [lock] = onlooker.locks()
    assert (lock.holder.container, lock.holder.purpose) == ("navigate", "navigation")

    # Its first way may be short, as it begins where the other one stopped. Later ones are from one end to the other.
    wait_until(lambda: len(events(read_log(log), "motion_started", device_id=1, since=began)) >= 2)
    killed = time.monotonic()
    navigating.signal(signal.SIGKILL)
    wait_until(lambda: events(read_log(log), "at_rest", device_id=1, since=killed))
    start = [one for one in events(read_log(log), "motion_started", device_id=1, since=began) if one.t < killed][-1]
    rest = events(read_log(log), "at_rest", device_id=1, since=killed)[0]
    assert start.position_rad is not None
    assert rest.position_rad is not None
    assert abs(start.position_rad) > 1.25
    assert abs(rest.position_rad - start.position_rad) < 1.25, "it stopped on its way, not at its goal"
    assert not events(read_log(log), "watchdog_expired")
    with onlooker.lock(HEAD, wait_s=20):
        assert [lock.holder.container for lock in onlooker.locks()] == ["onlooker"]
