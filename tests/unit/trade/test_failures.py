"""Errors across the wire: they arrive as themselves, with their attributes, or say what they were."""

import dataclasses
import pickle
import sys
import types
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec
import pytest

from trade import Container, Secret, errors, service, where
from trade.errors import CallerError, DeadlineExceeded, InvalidResult, LimitExceeded, RemoteError, TradeError
from trade.protocol.messages import ErrorInfo
from trade.protocol.remote_errors import RemoteTraceback, pack_error, unpack_error

pytestmark = pytest.mark.virtual_time

CONCRETE = [
    kind
    for name in errors.__all__
    if issubclass(kind := getattr(errors, name), TradeError) and kind.describe is not TradeError.describe
]


def sample(kind: type[TradeError]) -> TradeError:
    """One of that kind with a value in every field."""
    values: dict[Any, Any] = {str: "text", float: 1.5, int: 7, bool: True}
    hints = get_type_hints(kind)
    values |= {hint: get_args(hint)[0] for hint in hints.values() if get_origin(hint) is Literal}
    return kind(**{f.name: values.get(hints[f.name], ("one", "two")) for f in dataclasses.fields(kind)})


@dataclass(kw_only=True, eq=False)
class OutOfReach(CallerError, ValueError):
    """An error of a user's own, in the tree."""

    distance_m: float

    def describe(self) -> str:
        return f"{self.distance_m:.2f} m is too far"


class DriverError(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(f"code {code}")
        self.code = code


class NumberLike(float):
    """As numeric libraries have them."""


class Broken(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")

    __repr__ = __str__


class Raiser:
    def __init__(self, error: BaseException) -> None:
        self.error = error

    @service
    def go(self) -> None:
        raise self.error


def raised(here: Container, there: Container, error: BaseException) -> BaseException:
    """What a caller elsewhere gets for it."""
    there.register(Raiser(error), "robot")
    with pytest.raises(BaseException) as caught:
        here.find(where(name="go"), wait_s=20)()
    return caught.value


@pytest.mark.parametrize("kind", CONCRETE, ids=lambda kind: kind.__name__)
def test_every_error_of_the_tree_crosses_with_its_attributes(kind: type[TradeError]) -> None:
    error = sample(kind)
    back = unpack_error(msgspec.msgpack.decode(msgspec.msgpack.encode(pack_error(error)), type=ErrorInfo), "s")
    assert type(back) is kind
    assert str(back) == str(error)


@pytest.mark.parametrize("kind", CONCRETE, ids=lambda kind: kind.__name__)
def test_every_error_of_the_tree_can_be_pickled(kind: type[TradeError]) -> None:
    error = sample(kind)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_every_error_of_the_tree_is_public_and_documented() -> None:
    assert set(errors.__all__) == {
        name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, TradeError)
    }
    assert all(getattr(errors, name).__doc__ for name in errors.__all__)


def test_an_error_of_the_tree_arrives_as_itself(here: Container, there: Container) -> None:
    error = raised(here, there, LimitExceeded(what="angle", value=4.0, lower=0, upper=3.0, unit="rad"))
    assert isinstance(error, LimitExceeded)
    assert (error.what, error.value, error.unit) == ("angle", 4.0, "rad")


def test_numbers_of_other_libraries_arrive_as_numbers(here: Container, there: Container) -> None:
    error = raised(here, there, LimitExceeded(what="angle", value=NumberLike(4.0), lower=0, upper=3.0))
    assert isinstance(error, LimitExceeded)
    assert error.value == 4.0


def test_a_users_error_in_the_tree_arrives_as_itself(here: Container, there: Container) -> None:
    error = raised(here, there, OutOfReach(distance_m=2.5))
    assert isinstance(error, OutOfReach)
    assert (error.distance_m, str(error)) == (2.5, "2.50 m is too far")


def test_a_users_error_that_the_caller_knows_arrives_with_arguments_and_attributes(
    here: Container, there: Container
) -> None:
    error = raised(here, there, DriverError(7))
    assert isinstance(error, DriverError)
    assert (error.args, error.code) == (("code 7",), 7)


def test_the_traceback_of_the_far_side_is_the_cause(here: Container, there: Container) -> None:
    error = raised(here, there, DriverError(7))
    assert isinstance(error.__cause__, RemoteTraceback)
    assert "raise self.error" in str(error.__cause__)


def test_the_files_name_stays_with_an_os_error(here: Container, there: Container) -> None:
    error = raised(here, there, FileNotFoundError(2, "No such file or directory", "/dev/ttyUSB9"))
    assert isinstance(error, FileNotFoundError)
    assert error.filename == "/dev/ttyUSB9"


UNSENDABLE = {
    "object": (ValueError("bad", types), (ValueError, ("bad", str(types)))),
    "huge number": (ValueError(2**70), (ValueError, (str(2**70),))),
    "half a character": (ValueError("\ud800"), (ValueError, ("\\ud800",))),
    "no text": (Broken(), (Broken, ())),
    "exit": (SystemExit(3), (RemoteError, ())),
    "interrupt": (KeyboardInterrupt(), (RemoteError, ())),
    "generator exit": (GeneratorExit(), (RemoteError, ())),
}


@pytest.mark.parametrize(("error", "arrives"), UNSENDABLE.values(), ids=list(UNSENDABLE))
def test_an_error_that_cannot_be_sent_whole_still_arrives(
    here: Container, there: Container, error: BaseException, arrives: tuple[type, tuple[object, ...]]
) -> None:
    back = raised(here, there, error)
    assert (type(back), back.args) == arrives
    assert here.find(where(name="clock", container="there"))() > 0  # and the thread that ran it continues


def test_a_service_that_raises_system_exit_does_not_use_up_threads(here: Container, there: Container) -> None:
    there.register(Raiser(SystemExit(1)), "robot")
    go = here.find(where(name="go"), wait_s=20)
    for _ in range(100):  # more than there may be threads
        with pytest.raises(RemoteError, match=r"robot.go raised builtins:SystemExit: 1"):
            go()
    assert there.healthy()


def test_a_deadline_that_passed_inside_a_service_is_not_reported_as_its_own(here: Container, there: Container) -> None:
    """The service did run; that a call of its own came too late is its error."""
    error = raised(here, there, DeadlineExceeded(service="inner", deadline_s=1.0))
    assert isinstance(error, DeadlineExceeded)
    assert error.service == "inner"


@pytest.mark.realtime
def test_an_error_of_a_type_the_caller_does_not_know_says_what_it_was(start_program: Any, here: Container) -> None:
    program = start_program(
        """
        class GearStripped(Exception): pass
        class Gearbox:
            @service
            def turn(self) -> None:
                raise GearStripped("tooth 5")
        trade.register(Gearbox(), "robot")
        say("ready")
        hear()
        """
    )
    program.heard()
    with pytest.raises(RemoteError) as caught:
        here.find(where(name="turn"), wait_s=20)()
    assert (caught.value.type_name, caught.value.message) == ("__main__:GearStripped", "tooth 5")
    assert str(caught.value) == "robot.turn raised __main__:GearStripped: tooth 5"
    assert "in turn" in caught.value.traceback


FORGED = [
    ErrorInfo(type="antigravity:Anything", message="m"),
    ErrorInfo(type="builtins:print", message="m"),
    ErrorInfo(type="builtins:SystemExit", message="m"),
    ErrorInfo(type="", message="m"),
    ErrorInfo(type=":::", message="m"),
    ErrorInfo(type="subprocess:Popen", message="m", fields={"args": ["true"]}),
    ErrorInfo(type="trade.errors:LimitExceeded", message="m", fields={"unknown": 1}),
    ErrorInfo(type="trade.errors:LimitExceeded", message="m", fields={"what": "w", "value": "x"}),
    ErrorInfo(type="trade.errors:fields", message="m"),
    ErrorInfo(type="builtins:UnicodeDecodeError", message="m", fields={"args": [1]}),
    ErrorInfo(type="builtins:ValueError", message="m", fields={"args": 5}),
]


@pytest.mark.parametrize("info", FORGED, ids=lambda info: info.type or "nothing")
def test_an_error_that_makes_no_sense_becomes_a_remote_error(info: ErrorInfo) -> None:
    error = unpack_error(info, "robot.go")
    assert isinstance(error, RemoteError)
    assert str(error) == f"robot.go raised {info.type}: m"
    assert "antigravity" not in sys.modules


def test_looking_for_an_errors_type_runs_no_code_of_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    lazy = types.ModuleType("lazy_module")
    lazy.__getattr__ = lambda name: pytest.fail(f"{name} was asked for")  # type: ignore[method-assign]
    monkeypatch.setitem(sys.modules, "lazy_module", lazy)
    assert isinstance(unpack_error(ErrorInfo(type="lazy_module:Anything", message="m"), "s"), RemoteError)


class Clumsy:
    @service
    def drop(self, what: str, word: Secret[str] = "") -> None:
        raise OSError(f"dropped the {what} {word}")

    @service
    def lie(self) -> int:
        return "text"  # type: ignore[return-value]

    @service
    def leave(self) -> None:
        sys.exit(3)

    @service
    def refuse(self) -> None:
        raise LimitExceeded(what="speed", value=2.0, lower=0.0, upper=1.0)


def test_what_a_provider_raises_unmeant_is_logged_once_where_it_runs(
    here: Container, there: Container, caplog: pytest.LogCaptureFixture
) -> None:
    there.register(Clumsy(), "robot")
    names = ("drop", "lie", "leave", "refuse")
    drop, lie, leave, refuse = (here.find(where(name=name, group="robot"), wait_s=20) for name in names)
    with pytest.raises(OSError, match="dropped the cup"):
        drop("cup", "hunter2")
    with pytest.raises(InvalidResult):
        lie()
    with pytest.raises(RemoteError):
        leave()
    with pytest.raises(LimitExceeded):
        refuse()
    first, second, third = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert "robot.drop failed in a call of" in first
    assert "Traceback" in first
    assert "OSError: dropped the cup ***" in first
    assert "hunter2" not in first
    assert "robot.lie failed" in second
    assert "robot.leave failed" in third


@pytest.mark.parametrize(
    ("silent_s", "said"),
    [(0.005, "on /dev/x."), (0.0, "on /dev/x."), (0.34, "on /dev/x for 0.3 s."), (20.487, "on /dev/x for 20 s.")],
)
def test_device_silent_states_how_long_the_device_was_silent(silent_s: float, said: str) -> None:
    reported = str(errors.DeviceSilent(device="rosie.pan", bus="/dev/x", waited_s=silent_s))
    assert reported.startswith(f"rosie.pan did not answer {said} Is it powered")


@pytest.mark.parametrize("bus", ["/tmp/trade-sim-x1/neck", "socketcand:127.0.0.1:4242/can0"])
def test_a_silence_says_what_it_is_of_a_device_and_of_a_simulated_one(bus: str) -> None:
    reported = str(errors.DeviceSilent(device="rosie.pan", bus=bus, waited_s=0.3))
    assert "Is it powered, plugged in" in reported
    assert reported.endswith("If it is simulated, this computer may be too busy")
