"""Each fault and order as a method. Its body, help and most keywords come from the struct of its name."""
# ruff: noqa: B027 - the bodies of the methods are generated

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, Final, Literal, ParamSpec, TypedDict

from msgspec.structs import fields

from trade_hil_sim.faults._commands import Command, kinds_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

Ids = Iterable[int] | None
_P = ParamSpec("_P")
_KINDS: Final = kinds_of(Command)


class OnBus(TypedDict, total=False):
    """Where: the name of a bus; default: every bus."""

    bus: str | None


class AnswerSelection(OnBus, total=False):
    """Which answers: those to an instruction, after how many, and how many."""

    instruction: str | None
    skip: int
    count: int | None


def _generated(
    declared: "Callable[Concatenate[FaultMethods, _P], None]",
) -> "Callable[Concatenate[FaultMethods, _P], None]":
    """The method of a declaration: it makes a struct and carries it out."""
    kind = _KINDS[declared.__name__]
    signature = _signature(declared)

    @wraps(declared)
    def method(self: "FaultMethods", /, *args: _P.args, **kwargs: _P.kwargs) -> None:
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        given = bound.arguments
        del given["self"]
        if given.get("ids") is not None:
            given["ids"] = tuple(given["ids"])
        self.do(kind(**given))

    method.__doc__ = kind.__doc__
    setattr(method, "__signature__", signature)  # noqa: B010 - no type checker knows this attribute
    return method


def _signature(declared: Callable[..., None]) -> inspect.Signature:
    """The signature of a declaration, with the other fields of its struct in place of its ``**where``."""
    own = inspect.signature(declared)
    named = [parameter for parameter in own.parameters.values() if parameter.kind is not parameter.VAR_KEYWORD]
    others = [
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
        for field in fields(_KINDS[declared.__name__])
        if field.name not in own.parameters
    ]
    return own.replace(parameters=[*named, *others])


class FaultMethods(ABC):
    """Methods for all faults and orders; each makes the value and passes it to `do`."""

    @abstractmethod
    def do(self, command: Command) -> None:
        """Carry out any command of the simulator."""

    # faults of answers

    @_generated
    def mute(self, ids: Ids = None, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def unmute(self, ids: Ids = None, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def late(self, s: float, ids: Ids = None, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def bad_crc(self, ids: Ids = None, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def truncate(self, ids: Ids = None, *, missing: int = 3, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def garbage(self, ids: Ids = None, *, hex: str = "fffffd00ff", **which: "Unpack[AnswerSelection]") -> None: ...  # noqa: A002 - as the fault has it

    @_generated
    def dribble(self, s: float, ids: Ids = None, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def duplicate(self, ids: Ids = None, **which: "Unpack[AnswerSelection]") -> None: ...

    @_generated
    def heal(self, **where: "Unpack[OnBus]") -> None: ...

    # the line and the devices

    @_generated
    def unplug(self, bus: str | None = None) -> None: ...

    @_generated
    def replug(self, bus: str | None = None) -> None: ...

    @_generated
    def echo(self, *, on: bool = True, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def bus_off(self, ids: Ids = None, *, on: bool = True, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def hang_up(self, kind: Literal["rtde", "dashboard", "script"], **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def local(self, *, on: bool = True, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def absent(self, ids: Ids = None, *, nth: int | None = None, on: bool = True, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def brown_out(
        self, ids: Ids = None, *, zero: Literal["kept", "turn", "lost"] = "kept", **where: "Unpack[OnBus]"
    ) -> None: ...

    @_generated
    def hardware_fault(self, bits: int = 0x20, ids: Ids = None, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def emergency(self, code: int, ids: Ids = None, *, lasting: bool = False, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def freeze(self, ids: Ids = None, *, on: bool = True, tick: bool = False, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def jam(self, ids: Ids = None, *, on: bool = True, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def wrong_model(self, number: int, ids: Ids = None, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def supply(
        self,
        ids: Ids = None,
        *,
        voltage_v: float | None = None,
        temperature_c: int | None = None,
        **where: "Unpack[OnBus]",
    ) -> None: ...

    @_generated
    def place(self, counts: int, ids: Ids = None, **where: "Unpack[OnBus]") -> None: ...

    @_generated
    def put(
        self,
        width_m: float | None = None,
        ids: Ids = None,
        *,
        stiffness_n_m: float = 50_000.0,
        inside: bool = False,
        **where: "Unpack[OnBus]",
    ) -> None: ...
