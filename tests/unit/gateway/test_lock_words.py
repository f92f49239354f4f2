"""The words of ``trade lock`` and its kind: help with examples, and what follows two dashes is left as it is."""

import pytest
from typer.testing import CliRunner

from trade.errors import (
    DeviceFault,
    InvalidArgument,
    LockedByOther,
    LockLost,
    MotionStopped,
    OutcomeUnknown,
    ServiceGone,
    Stopped,
    TooManyServices,
)
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli._output import REMEDIES, say_error
from trade_gateway.cli.motion._lock import _wanted


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
    say_error(MotionStopped(device="rosie.pan", reason="its call reached its deadline; give it a longer one"))
    fault, stopped, ended = capsys.readouterr().err.splitlines()
    assert fault.endswith(
        "remove the cause, then `trade call rosie.arm.power_on` and `trade call rosie.arm.release_brakes`"
    )
    assert stopped.endswith("When it is safe to move, call `trade resume rosie.pan`")
    assert "--deadline SECONDS gives it more" in ended


def test_every_translated_remedy_belongs_to_an_error() -> None:
    errors = (
        LockedByOther(resources=("a",), owner="b"),
        LockLost(resources=("a",), reason="b"),
        ServiceGone(service="a"),
        TooManyServices(constraint="a", matches=["b"]),
        OutcomeUnknown(service="a", deadline_s=1),
        Stopped(resource="a", by="b", reason="c"),
        MotionStopped(device="a", reason="its call reached its deadline; give it a longer one"),
        InvalidArgument(service="a", argument="b", problem="with_(deadline_s=...) gives it more"),
    )
    assert all(any(remedy in str(error) for error in errors) for remedy in REMEDIES)
