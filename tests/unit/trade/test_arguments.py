"""Arguments are validated before any code of the provider runs; local and remote calls do not differ."""

import datetime as dt
import decimal
import enum
import math
import secrets
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

import pytest
from msgspec import Struct

from trade import Container, Handle, Meta, Settings, service, where
from trade.errors import InvalidArgument, InvalidResult, NotSerialisable


class Pose(Struct):
    x_m: float
    y_m: float = 0.0


@dataclass
class Twist:
    linear_mps: float
    angular_radps: float = 0.0


@dataclass(slots=True)
class Slotted:
    value: float


class Mode(enum.Enum):
    SLOW = "slow"
    FAST = "fast"


class Pair(NamedTuple):
    left: int
    right: float


class Options(TypedDict):
    retries: int


class Tagged(Struct, tag=True):
    a: int


class OtherTagged(Struct, tag=True):
    b: int


class CallerOnly:
    """A type no encoder knows."""


class KnownFailure(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(f"failed with {code}")
        self.code = code


class Provider:
    """Counts how often its own code runs."""

    runs = 0

    def _ran(self, value: Any = None) -> Any:
        self.runs += 1
        return value

    @service
    def number(self, value: float) -> float:
        return self._ran(value)

    @service(effect="read")
    def measure(self, value: float) -> float:
        return self._ran(value)

    @service
    def two(self, a: int, b: str = "b") -> str:
        return self._ran(f"{a}{b}")

    @service
    def named(self, a: int, b: int = 2, *, c: int, d: int = 4) -> list[int]:
        return self._ran([a, b, c, d])

    @service
    def optional_named(self, a: int = 1, *, c: int = 3) -> list[int]:
        return self._ran([a, c])

    @service
    def by_place(self, a: int, /, b: int = 2) -> list[int]:
        return self._ran([a, b])

    @service
    def nothing(self) -> None:
        self._ran()

    @service
    def limited(
        self,
        speed: Annotated[float, Meta(ge=0, le=1)] = 0.5,
        name: Annotated[str, Meta(max_length=3)] = "",
        joints: Annotated[list[int], Meta(max_length=2)] = [],  # noqa: B006
    ) -> float:
        return self._ran(speed)

    @service
    def pose(self, pose: Pose) -> Pose:
        return self._ran(Pose(pose.x_m + 1, pose.y_m))

    @service
    def path(self, poses: list[Pose]) -> list[Pose]:
        return self._ran(poses)

    @service
    def twist(self, twist: Twist) -> Twist:
        return self._ran(twist)

    @service
    def slotted(self, value: Slotted) -> Slotted:
        return self._ran(value)

    @service
    def anything(self, value: Any) -> Any:
        return self._ran(value)

    @service
    def maybe(self, value: float | None = None) -> float | None:
        return self._ran(value)

    @service
    def table(self, values: dict[str, list[float]]) -> dict[str, list[float]]:
        return self._ran(values)

    @service
    def mode(self, mode: Mode, kind: Literal["a", "b"] = "a") -> Mode:
        return self._ran(mode)

    @service
    def optional_handle(self, other: Handle | None = None) -> bool:
        return self._ran(other is None)

    @service
    def typed(self, options: Options) -> Options:
        return self._ran(options)

    @service
    def union(self, first: bool) -> Tagged | OtherTagged:
        return Tagged(1) if first else OtherTagged(2)

    @service
    def pair(self, pair: Pair) -> Pair:
        return self._ran(pair)

    @service
    def tuples(self) -> tuple[float, ...]:
        return (1.0, 2.0)

    @service
    def fixed(self) -> tuple[int, str]:
        return (1, "a")

    @service
    def sets(self, values: set[int]) -> set[int]:
        return self._ran(values)

    @service
    def frozen(self) -> frozenset[str]:
        return frozenset({"a"})

    @service
    def nested(self) -> dict[str, tuple[set[int], ...] | None]:
        return {"a": ({1}, {2}), "b": None}

    @service
    def by_number(self) -> dict[int, str]:
        return {1: "one"}

    @service
    def when(self) -> dt.datetime:
        return dt.datetime(2025, 1, 2, 3, 4, 5, 6)  # noqa: DTZ001

    @service
    def moments(self) -> list[dt.datetime | None]:
        return [dt.datetime(2025, 1, 2, tzinfo=dt.timezone.utc), None]

    @service
    def day(self) -> tuple[dt.date, dt.time, dt.timedelta]:
        return dt.date(2025, 1, 2), dt.time(3, 4), dt.timedelta(seconds=5)

    @service
    def ident(self) -> uuid.UUID:
        return uuid.UUID(int=5)

    @service
    def price(self) -> decimal.Decimal:
        return decimal.Decimal("1.50")

    @service
    def data(self) -> bytes:
        return b"\x00\xff"

    @service
    def buffer(self) -> bytearray:
        return bytearray(b"\x00\xff")

    @service
    def whole(self) -> float:
        return 1

    @service
    def untyped(self, value: Any):  # type: ignore[no-untyped-def]
        return value

    @service
    def wrong_result(self) -> int:
        return "text"  # type: ignore[return-value]

    @service
    def boolean_as_number(self) -> int:
        return True

    @service
    def wrong_inner_result(self) -> list[Pose]:
        return [Pose(1), Pose("x")]  # type: ignore[arg-type]

    @service
    def unsendable_result(self) -> Any:
        return {"caller": CallerOnly()}

    @service
    def huge_result(self) -> int:
        return 2**70

    @service
    def half_a_character(self) -> str:
        return "\ud800"

    @service
    def fails(self, how: str) -> None:
        errors: dict[str, BaseException] = {
            "builtin": ValueError("no such joint", 5),
            "os": FileNotFoundError(2, "No such file", "/dev/nope"),
            "key": KeyError("pan"),
            "unicode": UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"),
            "bytes": ValueError(b"\xff"),
            "known": KnownFailure(7),
            "timeout": TimeoutError("device"),
            "exit": SystemExit(3),
            "generator": GeneratorExit(),
            "stop": StopIteration(4),
        }
        raise errors[how]


def outcome(call: Callable[[], Any]) -> Any:
    """What a caller can see of a call: the value with its types, or the error with its text."""
    try:
        value = call()
    except BaseException as error:  # noqa: BLE001 - SystemExit, too
        return type(error), str(error)
    return type(value), repr(value)


Case = Callable[[Callable[[str], Handle]], Any]

CASES: dict[str, Case] = {
    "number": lambda s: s("number")(0.5),
    "integer for a number": lambda s: s("number")(1),
    "text for a number": lambda s: s("number")("1"),
    "number for a text": lambda s: s("two")(1, 2),
    "truth for an integer": lambda s: s("two")(True),
    "fraction for an integer": lambda s: s("two")(1.5),
    "whole fraction for an integer": lambda s: s("two")(1.0),
    "none for a number": lambda s: s("number")(None),
    "missing": lambda s: s("two")(),
    "missing by name": lambda s: s("two")(b="x"),
    "extra": lambda s: s("two")(1, "b", 3),
    "extra with name": lambda s: s("two")(1, "b", 3, c=1),
    "extra for none": lambda s: s("nothing")(1),
    "twice": lambda s: s("two")(1, a=1),
    "unknown": lambda s: s("two")(1, c=1),
    "unknown and missing": lambda s: s("two")(c=1),
    "default": lambda s: s("two")(1),
    "by name": lambda s: s("two")(b="x", a=1),
    "mixed": lambda s: s("two")(1, b="x"),
    "keyword-only": lambda s: s("named")(1, c=3),
    "keyword-only all": lambda s: s("named")(b=1, a=2, d=3, c=4),
    "keyword-only missing": lambda s: s("named")(1, 2),
    "keyword-only by place": lambda s: s("named")(1, 2, 3),
    "keyword-only by place when optional": lambda s: s("optional_named")(1, 2),
    "keyword-only default": lambda s: s("optional_named")(),
    "keyword-only wrong": lambda s: s("named")(1, c="x"),
    "gap in the middle": lambda s: s("named")(1, d=5, c=6),
    "positional-only": lambda s: s("by_place")(1),
    "positional-only by name": lambda s: s("by_place")(a=1, b=2),
    "nothing": lambda s: s("nothing")(),
    "limit met": lambda s: s("limited")(1.0),
    "limit broken": lambda s: s("limited")(1.01),
    "limit broken by name": lambda s: s("limited")(speed=-0.1),
    "text too long": lambda s: s("limited")(0.1, "abcd"),
    "too many": lambda s: s("limited")(0.1, "a", [1, 2, 3]),
    "nan": lambda s: s("number")(math.nan),
    "infinity": lambda s: s("number")(math.inf),
    "minus infinity by name": lambda s: s("number")(value=-math.inf),
    "nan to a reading service": lambda s: s("measure")(math.nan),
    "nan in a limit": lambda s: s("limited")(math.nan),
    "nan in a struct": lambda s: s("pose")(Pose(math.nan)),
    "nan in a list of structs": lambda s: s("path")([Pose(1.0), Pose(1.0, math.inf)]),
    "nan in a dataclass": lambda s: s("twist")(Twist(0.0, math.nan)),
    "nan in a slotted dataclass": lambda s: s("slotted")(Slotted(math.nan)),
    "nan in a table": lambda s: s("table")({"a": [1.0, math.nan]}),
    "nan in anything": lambda s: s("anything")({"a": [{"b": (1, math.nan)}]}),
    "nan in an optional": lambda s: s("maybe")(math.nan),
    "struct": lambda s: s("pose")(Pose(1.5)),
    "struct by name": lambda s: s("pose")(pose=Pose(1.5, 2.5)),
    "mapping for a struct": lambda s: s("pose")({"x_m": 1.0}),
    "wrong inside a struct": lambda s: s("pose")({"x_m": "a"}),
    "wrong deep inside": lambda s: s("path")([Pose(1.0), {"x_m": None}]),
    "wrong in a table": lambda s: s("table")({"a": ["x"]}),
    "dataclass": lambda s: s("twist")(Twist(1.0)),
    "slotted dataclass": lambda s: s("slotted")(Slotted(1.0)),
    "anything": lambda s: s("anything")({"a": [1, 2.5, "x", None, b"y", True]}),
    "tuple in anything": lambda s: s("anything")((1, 2)),
    "none for an optional": lambda s: s("maybe")(None),
    "optional": lambda s: s("maybe")(2.5),
    "optional left out": lambda s: s("maybe")(),
    "optional handle left out": lambda s: s("optional_handle")(),
    "optional handle none": lambda s: s("optional_handle")(None),
    "optional handle": lambda s: s("optional_handle")(s("nothing")),
    "text for a handle": lambda s: s("optional_handle")("nothing"),
    "enumeration": lambda s: s("mode")(Mode.FAST),
    "value of an enumeration": lambda s: s("mode")("slow"),
    "wrong enumeration": lambda s: s("mode")("warp"),
    "wrong literal": lambda s: s("mode")(Mode.FAST, "c"),
    "typed mapping": lambda s: s("typed")({"retries": 3}),
    "wrong typed mapping": lambda s: s("typed")({"retries": "x"}),
    "union": lambda s: s("union")(True),
    "other of a union": lambda s: s("union")(False),
    "named tuple": lambda s: s("pair")(Pair(1, 2.0)),
    "tuple result": lambda s: s("tuples")(),
    "fixed tuple result": lambda s: s("fixed")(),
    "set": lambda s: s("sets")({1, 2}),
    "frozen set result": lambda s: s("frozen")(),
    "nested result": lambda s: s("nested")(),
    "mapping by number": lambda s: s("by_number")(),
    "date and time": lambda s: s("when")(),
    "dates and times": lambda s: s("moments")(),
    "date, time, duration": lambda s: s("day")(),
    "uuid": lambda s: s("ident")(),
    "decimal": lambda s: s("price")(),
    "bytes": lambda s: s("data")(),
    "bytearray": lambda s: s("buffer")(),
    "integer as a number": lambda s: s("whole")(),
    "no annotation": lambda s: s("untyped")([1, "a"]),
    "wrong result": lambda s: s("wrong_result")(),
    "truth as a number": lambda s: s("boolean_as_number")(),
    "wrong inside a result": lambda s: s("wrong_inner_result")(),
    "unsendable result": lambda s: s("unsendable_result")(),
    "huge result": lambda s: s("huge_result")(),
    "half a character": lambda s: s("half_a_character")(),
    "unsendable argument": lambda s: s("anything")(CallerOnly()),
    "unsendable deep": lambda s: s("anything")([{"a": CallerOnly()}]),
    "unsendable by name": lambda s: s("two")(1, b=CallerOnly()),
    "unsendable extra": lambda s: s("nothing")(CallerOnly()),
    "huge argument": lambda s: s("anything")(2**70),
    "half a character as argument": lambda s: s("anything")("\udfff"),
    **{
        f"error: {how}": lambda s, how=how: s("fails")(how)
        for how in (
            *("builtin", "os", "key", "unicode", "bytes"),
            *("known", "timeout", "exit", "generator", "stop"),
        )
    },
}


@pytest.fixture(scope="module")
def both() -> Iterator[tuple[Callable[[str], Handle], Callable[[str], Handle], list[Provider]]]:
    """One provider here and one there, under the same group so that even texts must be the same."""
    system = f"test-{secrets.token_hex(4)}"
    local, remote = Provider(), Provider()
    with (
        Container(Settings.read(system=system, container="here")) as here,
        Container(Settings.read(system=system, container="there")) as there,
    ):
        here.register(local, "robot")
        there.register(remote, "robot")

        def found(name: str, *, local: bool) -> Handle:
            return here.find(where(name=name, local=local, group="robot"), wait_s=20)

        found("nothing", local=False)()  # starts the threads that stay
        yield partial(found, local=True), partial(found, local=False), [local, remote]


@pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
def test_a_local_call_yields_exactly_what_a_remote_one_does(case: Case, both: Any) -> None:
    local, remote, (local_provider, remote_provider) = both
    local_provider.runs = remote_provider.runs = 0
    assert outcome(lambda: case(local)) == outcome(lambda: case(remote))
    assert local_provider.runs == remote_provider.runs


INVALID: dict[str, tuple[Case, str, str]] = {
    "wrong type": (lambda s: s("number")("1"), "value", "Expected `float`, got `str`"),
    "wrong type by name": (lambda s: s("number")(value="1"), "value", "Expected `float`, got `str`"),
    "missing": (lambda s: s("two")(), "a", "missing"),
    "missing by name": (lambda s: s("two")(b="x"), "a", "missing"),
    "keyword-only missing": (lambda s: s("named")(1), "c", "missing"),
    "extra": (lambda s: s("two")(1, "b", 3), "", "takes at most 2 positional arguments, got 3"),
    "extra with name": (lambda s: s("two")(1, "b", 3, c=4), "", "takes at most 2 positional arguments, got 3"),
    "keyword-only by place": (lambda s: s("optional_named")(1, 2), "", "takes at most 1 positional argument, got 2"),
    "twice": (lambda s: s("two")(1, a=1), "a", "given twice"),
    "unknown": (lambda s: s("two")(1, c=1), "c", "there is no such argument"),
    "limit": (lambda s: s("limited")(1.5), "speed", "Expected `float` <= 1.0, but is 1.5"),
    "nan within limits": (lambda s: s("limited")(math.nan), "speed", "must be finite: no NaN, no infinity"),
    "deep": (lambda s: s("path")([Pose(0.0), {"x_m": None}]), "poses", "Expected `float`, got `None` (at [1].x_m)"),
    "nan": (lambda s: s("number")(math.nan), "value", "must be finite: no NaN, no infinity"),
    "infinity by name": (lambda s: s("number")(value=math.inf), "value", "must be finite: no NaN, no infinity"),
    "nan nested": (lambda s: s("path")([Pose(math.nan)]), "poses", "must be finite: no NaN, no infinity"),
    "nan in a slotted dataclass": (lambda s: s("slotted")(Slotted(math.nan)), "value", "must be finite"),
    "not a handle": (lambda s: s("optional_handle")(5), "other", "Expected `Handle`, got `int`"),
}


@pytest.mark.parametrize("where_it_runs", ["local", "remote"])
@pytest.mark.parametrize(("case", "argument", "problem"), INVALID.values(), ids=list(INVALID))
def test_an_invalid_argument_is_named_and_no_provider_code_runs(
    both: Any, case: Case, argument: str, problem: str, where_it_runs: str
) -> None:
    index = ["local", "remote"].index(where_it_runs)
    provider = both[2][index]
    provider.runs = 0
    with pytest.raises(InvalidArgument) as refused:
        case(both[index])
    assert refused.value.argument == argument
    assert problem in refused.value.problem
    assert refused.value.signature in str(refused.value)
    assert provider.runs == 0


def test_an_invalid_argument_is_a_value_error_and_a_type_error(offer: Any) -> None:
    found = offer(Provider())
    for builtin in (ValueError, TypeError):
        with pytest.raises(builtin):
            found("number")("x")


def test_reading_services_may_be_asked_about_infinity(offer: Any) -> None:
    assert offer(Provider())("measure")(math.inf) == math.inf


def test_an_argument_that_cannot_be_sent_is_named(offer: Any) -> None:
    with pytest.raises(NotSerialisable, match=r"robot.two: argument 'b' cannot be sent: CallerOnly is no plain data"):
        offer(Provider())("two")(1, b=CallerOnly())


class Measured(float):
    """As the numbers that an array has."""


class Counted:
    def __index__(self) -> int:
        return 3


class Array:
    def tolist(self) -> list[float]:
        return [0.5]


def test_numbers_of_other_kinds_are_sent_as_numbers(offer: Any) -> None:
    find = offer(Provider())
    assert find("number")(Measured(0.25)) == 0.25
    assert find("two")(Counted()) == "3b"


def test_an_array_is_to_be_sent_as_a_list(offer: Any) -> None:
    with pytest.raises(NotSerialisable, match=r"Array is no plain data; send value.tolist\(\)"):
        offer(Provider())("two")(1, b=Array())


def test_a_result_that_cannot_be_sent_is_the_providers_fault(offer: Any) -> None:
    with pytest.raises(NotSerialisable, match=r"robot.unsendable_result: its result cannot be sent"):
        offer(Provider())("unsendable_result")()


def test_a_result_that_breaks_its_annotation_is_the_providers_fault(offer: Any) -> None:
    with pytest.raises(InvalidResult, match=r"robot.wrong_result ran, but .* Expected `int`, got `str`"):
        offer(Provider())("wrong_result")()


@pytest.mark.parametrize("how", ["plain", "inside"])
def test_changing_an_argument_after_the_call_does_not_reach_the_provider(offer: Any, how: str) -> None:
    class Keeper:
        kept: Any = None

        @service
        def keep(self, value: Any) -> None:
            self.kept = value

    keeper = Keeper()
    mine = {"list": [1, 2]}
    offer(keeper)("keep")(mine["list"] if how == "plain" else mine)
    mine["list"].append(3)
    assert keeper.kept in ([1, 2], {"list": [1, 2]})


def test_changing_a_result_does_not_reach_the_provider(offer: Any) -> None:
    class Owner:
        poses = [Pose(1.0)]  # noqa: RUF012

        @service(effect="read")
        def give(self) -> list[Pose]:
            return self.poses

        @service(effect="read")
        def untyped(self):  # type: ignore[no-untyped-def]
            return self.poses[0].__struct_fields__ and [[1]]

    owner = Owner()
    result = offer(owner)("give")()
    result[0].x_m = 9.0
    result.clear()
    assert owner.poses == [Pose(1.0)]


def test_arguments_of_a_started_call_are_those_of_the_moment_it_started(offer: Any) -> None:
    class Listener:
        @service
        def hear(self, words: list[str]) -> list[str]:
            return words

    hear = offer(Listener())("hear")
    for _ in range(20):
        words = ["go"]
        run = hear.start(words)
        words.append("stop")
        assert run.result(20) == ["go"]


def test_a_started_call_refuses_at_once_what_cannot_be_sent(offer: Any) -> None:
    with pytest.raises(NotSerialisable):
        offer(Provider())("anything").start(CallerOnly())
