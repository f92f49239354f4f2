"""The words of ``trade lock`` and its kind: help with examples, and what follows two dashes is left as it is."""

import re

import pytest
from typer.testing import CliRunner

from trade import errors
from trade.errors import (
    DeviceFault,
    IncompleteGroup,
    InvalidArgument,
    LockedByOther,
    LockLost,
    MotionStopped,
    OutcomeUnknown,
    ServiceGone,
    Stopped,
    TooManyServices,
    TradeError,
    at_terminal,
)
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli.motion._lock import _wanted
from trade_gateway.terminal._output import say_error


def test_the_usage_says_where_the_command_goes() -> None:
    said = CliRunner().invoke(app, ["lock", "--help"])
    assert "-- COMMAND [ARGUMENT]..." in said.stdout


def test_options_after_the_dashes_belong_to_the_command_and_those_before_to_trade_lock() -> None:
    assert CliRunner().invoke(app, ["lock", "--no-such", "--", "true"]).exit_code == 2
    said = CliRunner().invoke(app, ["lock", "--", "true", "--help", "--no-such"])
    assert isinstance(said.exception, UsageError)  # no TradeError: the mistake is that there is nothing to lock
    assert "say what to lock" in str(said.exception)


def test_names_are_alternatives_within_the_group() -> None:
    assert str(_wanted("rosie", ["move_to", "enable"])).count("rosie") == 2
    with pytest.raises(UsageError, match="say what to lock"):
        _wanted(None, [])


def test_remedies_are_given_as_commands(capsys: pytest.CaptureFixture[str]) -> None:
    say_error(LockedByOther(resources=("rosie.pan",), owner="anna/desk"))
    say_error(LockLost(resources=("rosie.pan",), reason="its lease ended"))
    say_error(ServiceGone(service="rosie.pan.move_to"))
    reported = capsys.readouterr().err
    assert "`trade lock --wait SECONDS`" in reported
    assert "`trade unlock GROUP --break REASON`" in reported
    assert "trade.lock(" not in reported
    assert "trade.find(" not in reported


def test_the_remedy_of_a_device_is_given_as_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    remedy = "remove the cause, then call power_on() and release_brakes()"
    say_error(DeviceFault(device="rosie.arm", bus="/dev/x", fault="overload", remedy=remedy))
    say_error(Stopped(resource="rosie.pan", by="anna/desk", reason="stop"))
    say_error(MotionStopped(device="rosie.pan", reason="its call reached its deadline", late=True))
    fault, stopped, ended = capsys.readouterr().err.splitlines()
    assert fault.endswith(
        "remove the cause, then `trade call rosie.arm.power_on` and `trade call rosie.arm.release_brakes`"
    )
    assert stopped.endswith("When it is safe to move, call `trade resume rosie.pan`")
    assert ended.endswith("Give it more time with --deadline SECONDS")


def _errors() -> list[TradeError]:
    return [
        LockedByOther(resources=("a",), owner="b"),
        LockLost(resources=("a",), reason="b"),
        IncompleteGroup(group="a", missing=["b"]),
        ServiceGone(service="a"),
        TooManyServices(constraint="a", matches=["b"]),
        OutcomeUnknown(service="a", deadline_s=1),
        Stopped(resource="a", by="b", reason="c"),
        Stopped(resource="a", by="b", reason="c", estop=True),
        MotionStopped(device="a", reason="its call reached its deadline", late=True),
        InvalidArgument(service="a", argument="b", problem="lasts 3 s", late=True),
    ]


@pytest.mark.parametrize("error", _errors(), ids=lambda error: type(error).__name__)
def test_no_advice_at_a_terminal_names_python(error: TradeError) -> None:
    python = re.compile(r"trade\.[a-z_]+\(|with_\(|partial=")
    assert "`trade " in at_terminal(error) or " --" in at_terminal(error)
    assert not python.search(at_terminal(error))
    assert python.search(str(error)) or "`trade estop" in str(error)


def test_every_error_with_other_advice_at_a_terminal_is_tried_here() -> None:
    advising = {kind for kind in vars(errors).values() if isinstance(kind, type) and "advice" in vars(kind)}
    assert advising - {TradeError} == {type(error) for error in _errors()}
