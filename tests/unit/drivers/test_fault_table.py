"""Every row of the table of faults: the error, the state, what ends the motion, and that nothing moves on recovery."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.fault_row import Recovery, Row, Stop
from tests.unit.drivers.fault_subjects import OWN_CLOCK, SUBJECTS, Subject
from tests.unit.drivers.fault_table import TABLE, page
from trade.errors import DeviceError, DeviceFault

_ARRIVED = 0.97
_TURNS_S = 0.05
_NOTHING = 0.005
"""Less than this share of the move is no motion: 0.4 degrees, 0.3 mm."""


def _rows(rows: list[Row]) -> pytest.MarkDecorator:
    """On virtual time, where a device's driver can be."""
    return pytest.mark.parametrize("row", [pytest.param(row, id=row.name, marks=_time_of(row)) for row in rows])


def _time_of(row: Row) -> pytest.MarkDecorator:
    return pytest.mark.realtime if row.device in OWN_CLOCK else pytest.mark.virtual_time


@pytest.fixture
def subject(row: Row, tmp_path: Path) -> Iterator[Subject]:
    with ExitStack() as undo:
        yield SUBJECTS[row.device](tmp_path, undo)


@_rows([row for row in TABLE if row.error])
def test_a_fault_while_moving_ends_the_move_and_nothing_moves_on_recovery(row: Row, subject: Subject) -> None:
    moving = subject.set_off()
    struck = written_now()
    subject.strike(*row.strike)
    error = moving.wait().error
    assert row.error is not None
    assert isinstance(error, row.error), error
    assert _one_of(row.says, str(error))
    _check_stop(row, subject, struck)

    stood, rested = subject.travelled, written_now()
    wait_until(lambda: _reports(subject, row.state), f"state() reports {row.state!r}")
    wait_until(lambda: _one_of(row.registry, subject.reported.get(subject.provider, "healthy")), row.registry)
    if row.refuses:
        _check_refused(row, subject)
    if row.then:
        subject.strike(*row.then)
        wait_until(lambda: row.found in _latched(subject), "it is found out")
        _check_refused(row, subject)

    cured = written_now()
    subject.strike(*row.cure)
    wait_until(lambda: subject.fault() is not None, "it answers again")
    subject.wait_for_exchanges(written_now())
    assert not subject.moves(cured)
    went = [place - stood for place in (*subject.places(rested), subject.travelled)]
    assert all(abs(away) < _NOTHING for away in went), went
    if row.recovery is not Recovery.NOTHING:
        with pytest.raises(DeviceFault):
            subject.use()
    subject.recover(row.recovery, cured)
    subject.use()
    assert subject.provider.state().fault == ""
    wait_until(lambda: subject.reported.get(subject.provider, "healthy") == "healthy", "it is healthy")


@_rows([row for row in TABLE if not row.error])
def test_a_small_fault_goes_unnoticed(row: Row, subject: Subject) -> None:
    subject.make_ready()
    subject.strike(*row.strike)
    subject.use()
    assert subject.fault() == ""
    subject.strike(*row.cure)


def test_the_page_of_the_docs_is_what_the_table_says() -> None:
    kept = (Path(__file__).parents[3] / "docs" / "faults.md").read_text(encoding="utf-8")
    assert kept == page(), "write it again: python -m tests.unit.drivers.fault_table > docs/faults.md"


def _rests(subject: Subject) -> bool:
    """Whether it is at rest: one that holds an earlier place turns round, and stands for a moment."""
    place = subject.travelled
    if not subject.truth.moving:
        time.sleep(_TURNS_S)
    return not subject.truth.moving and subject.travelled == place


def _check_stop(row: Row, subject: Subject, struck: float) -> None:
    """What ended the motion, by the log of the simulator."""
    if row.stop in {Stop.WATCHDOG, Stop.BOTH}:
        wait_until(lambda: subject.events("watchdog_expired", struck), "its watchdog expires")
    wait_until(lambda: _rests(subject), "it is at rest")
    assert (subject.travelled > _ARRIVED) == (row.stop is Stop.GOAL)
    if row.stop in {Stop.HOLD, Stop.BOTH, Stop.HOLD_OR_PROGRAM}:
        wait_until(lambda: subject.holds(struck), "it has heard that it is to hold")
        wait_until(lambda: _rests(subject), "it is at rest there")
    if row.stop is Stop.UNTOLD:
        wait_until(lambda: _reports(subject, row.state), "its silence is noticed")
        assert not subject.holds(struck)
    if row.stop is Stop.BLOCKED:
        wait_until(lambda: subject.holds(struck) or _ended_itself(subject, struck), "it holds, or has let go")
    if row.stop is Stop.HOLD:
        assert not subject.events("watchdog_expired", struck)
    if row.stop in {Stop.ITSELF, Stop.PROGRAM, Stop.HOLD_OR_PROGRAM}:
        wait_until(lambda: _ended_itself(subject, struck), "it has ended it, or its program was ended")


def _ended_itself(subject: Subject, since: float) -> bool:
    return any(subject.events(name, since) for name in subject.ends)


def _check_refused(row: Row, subject: Subject) -> None:
    """Nothing moves it; a stop says whether it can be believed."""
    with pytest.raises(DeviceError):
        subject.use()
    if row.stop_error is None:
        subject.provider.stop()
    else:
        with pytest.raises(row.stop_error):
            subject.provider.stop()


def _reports(subject: Subject, wanted: type[DeviceError] | str) -> bool:
    try:
        fault = subject.provider.state().fault
    except DeviceError as error:
        return isinstance(wanted, type) and isinstance(error, wanted)
    return isinstance(wanted, str) and (_one_of(wanted, fault) if wanted else not fault)


def _one_of(wanted: str, text: str) -> bool:
    """Of a servo whose values and clock stand still, it is chance which is noticed first."""
    return any(words in text for words in wanted.split(", or "))


def _latched(subject: Subject) -> str:
    [device] = getattr(subject.provider, "_axes", None) or [subject.provider._device]
    return str(device.fault)
