"""Log lines of the whole system: kept where they are logged, gathered from anywhere, each once."""

import logging
from collections.abc import Callable
from typing import Any

import pytest

from trade import Container, LogReader, current_call, service, where
from trade._telemetry.log_buffer import Logbook

pytestmark = pytest.mark.virtual_time

_log = logging.getLogger("trade")

BABBLES = """
    import logging
    with Container(Settings.read(container="babbler")):
        while (word := hear()) != "end":
            logging.getLogger("trade").warning("babble %s", word)
            say("logged")
"""


def _record(text: str, *args: object, **options: Any) -> logging.LogRecord:
    return logging.LogRecord("trade", logging.WARNING, __file__, 1, text, args, options.get("exc_info"))


@pytest.mark.realtime
def test_lines_of_other_processes_are_gathered(here: Container, start_program: Callable[..., Any]) -> None:
    babbler = start_program(BABBLES)
    here.find(where(name="log_lines", container="babbler"), wait_s=20)
    babbler.tell("one")
    assert babbler.heard() == "logged"
    found = [line for line in here.logs() if line.text == "babble one"]
    assert [(line.container, line.level_name, line.call_id) for line in found] == [("babbler", "WARNING", 0)]
    assert here.logs(container="her*") == [line for line in here.logs() if line.container == "here"]
    assert babbler.errors() == "babble one\n", "what it says on standard error stays as it was"
    babbler.tell("end")
    assert babbler.ends() == 0


def test_containers_of_one_process_report_a_line_once(here: Container, there: Container) -> None:
    here.find(where(name="log_lines", container="there"), wait_s=20)
    _log.warning("only once")
    assert [line.text for line in here.logs()].count("only once") == 1


def test_a_reader_reads_on(here: Container, there: Container) -> None:
    reader = LogReader(here, "*")

    def read() -> list[str]:  # what others of this process log meanwhile left out
        return [line.text for line in reader.read() if line.text in ("first", "second", "third")]

    _log.warning("first")
    assert read()[-1:] == ["first"]
    _log.warning("second")
    _log.warning("third")
    assert read() == ["second", "third"]
    assert read() == []


def test_a_clock_that_is_set_back_changes_the_order_of_no_process(here: Container) -> None:
    hour_ago = _record("after the clock was set back")
    hour_ago.created -= 3600.0
    for record in (_record("before"), hour_ago, _record("at last")):
        _log.handle(record)
    own = ("before", "after the clock was set back", "at last")
    assert tuple(line.text for line in here.logs() if line.text in own) == own


def test_lines_are_bounded_in_number_and_length() -> None:
    book = Logbook()
    for number in range(2100):
        assert book.filter(_record("%s %d", "x" * 5000, number))
    lines = book.lines()
    assert (len(lines), lines[0].number, len(lines[0].text)) == (2000, 101, 2000)
    assert [line.number for line in book.lines(2098)] == [2099, 2100]


def test_a_line_that_cannot_be_written_is_kept_as_it_is() -> None:
    book = Logbook()
    book.filter(_record("%d of %d", "many"))
    assert [line.text for line in book.lines()] == ["%d of %d"]


def test_an_error_logged_with_a_line_is_sent_with_its_type() -> None:
    book = Logbook()
    book.filter(_record("it failed", exc_info=(ValueError, ValueError("swordfish"), None)))
    assert [line.text for line in book.lines()] == ["it failed (ValueError)"]


def test_formatters_know_the_call(here: Container, caplog: pytest.LogCaptureFixture) -> None:
    _log.warning("outside")
    assert [record.call_id for record in caplog.records] == [0]  # type: ignore[attr-defined]


class Leg:
    @service
    def step(self) -> None:
        _log.warning("the leg steps")


class Mind:
    def __init__(self, container: Container) -> None:
        self.container = container

    @service
    def walk(self) -> int:
        _log.warning("the mind walks")
        self.container.call(where(name="step"))
        call = current_call()
        assert call is not None
        return call.id


def test_all_that_comes_of_one_call_has_its_id(here: Container, there: Container) -> None:
    far: Container = there
    far.register(Leg(), "leg")
    here.register(Mind(here), "mind")
    here.find(where(name="step"), wait_s=20)
    walked = far.find(where(name="walk"), wait_s=20)()
    lines = {line.text: line for line in here.logs() if line.text in ("the mind walks", "the leg steps")}
    assert {line.outer_id for line in lines.values()} == {walked}
    assert lines["the mind walks"].call_id == walked
    assert lines["the leg steps"].call_id not in (0, walked)


def test_formatters_know_the_call_that_began_it_all(here: Container, caplog: pytest.LogCaptureFixture) -> None:
    here.register(Leg(), "leg")
    here.call(where(name="step"))
    [record] = [record for record in caplog.records if record.getMessage() == "the leg steps"]
    assert record.outer_id == record.call_id != 0  # type: ignore[attr-defined]
