"""The decorator ``@service``, and the services that a class provides with its interfaces."""

# pyright: reportUnknownArgumentType=false

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, overload

from trade._registry.constraints import checked_meta
from trade._registry.predicates import parse_condition
from trade.errors import ConfigurationError
from trade.protocol.messages import Scalar

Effect = Literal["read", "note", "actuate", "stop"]

_Function = TypeVar("_Function", bound=Callable[..., Any])
_MARK = "__trade_service__"
_PROVIDER = "__trade_provider__"
_EFFECTS = ("read", "note", "actuate", "stop")


@dataclass(frozen=True, slots=True, eq=False)
class ServiceMark:
    """The options of ``@service`` on a method; each decoration has its own."""

    effect: Effect = "actuate"
    cancel: str | None = None
    needs: tuple[str, ...] = ()
    achieves: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    meta: Mapping[str, Scalar] = field(default_factory=dict[str, Scalar])
    serial: bool = False
    strict: bool = True
    guard: Callable[..., str | None] | None = None


@overload
def service(function: _Function, /) -> _Function: ...
@overload
def service(
    *,
    effect: Effect = "actuate",
    cancel: str | None = None,
    needs: Sequence[str] = (),
    achieves: Sequence[str] = (),
    uses: Sequence[str] = (),
    meta: Mapping[str, Scalar] | None = None,
    serial: bool = False,
    strict: bool = True,
    guard: Callable[..., str | None] | None = None,
) -> Callable[[_Function], _Function]: ...
def service(
    function: Callable[..., Any] | None = None,
    /,
    *,
    effect: Effect = "actuate",
    cancel: str | None = None,
    needs: Sequence[str] = (),
    achieves: Sequence[str] = (),
    uses: Sequence[str] = (),
    meta: Mapping[str, Scalar] | None = None,
    serial: bool = False,
    strict: bool = True,
    guard: Callable[..., str | None] | None = None,
) -> Any:
    """Mark a method as a service, in a class or in an interface whose implementations then have it; or a function.

    Args:
        effect: ``"read"`` changes nothing; ``"note"`` only records something, so that no lock takes or delays it;
            ``"actuate"`` (default) may move something or change state; ``"stop"`` ends motion: it overtakes everything
            and ignores deadlines.
        cancel: name of the service of the same provider that ends this one early.
        needs: pre-conditions, predicates such as ``"see(?object)"``. They describe the service, and refuse no call.
        achieves: post-conditions, predicates such as ``"open(gripper)"`` or ``"at(?place)"``.
        uses: physical resources that it needs exclusively.
        meta: numbers, texts and booleans by name, for queries: ``{"payload_kg": 2}``.
        serial: it never runs at the same time as another serial service of the object; calls queue in order of arrival.
        strict: a local call behaves like a remote one, with validated arguments and copies. False: it passes arguments
            by reference, neither checked nor copied; a service that needs physical resources is always strict.
        guard: a function that may refuse a call before it runs, as for `trade.guard`. It gets the object first, as the
            method does, and then the call, a `HookEvent`. It has one second.

    Raises:
        ConfigurationError: the effect is unknown, the options contradict each other, a condition is malformed, or
            metadata is not a plain value.
    """
    if effect not in _EFFECTS:
        raise ConfigurationError(problem=f"effect must be one of {', '.join(_EFFECTS)}, not {effect!r}")
    if serial and effect == "stop":
        raise ConfigurationError(problem="a stop cannot be serial, because a stop never waits")
    if uses and effect == "note":
        raise ConfigurationError(problem='a note uses no resources; leave out uses, or write effect="actuate"')
    if guard is not None:
        require_check("@service", guard)
        if effect == "stop":
            raise ConfigurationError(problem="a stop cannot have a guard, because nothing may refuse it")
    mark = ServiceMark(
        effect,
        cancel,
        _conditions(needs, "pre-condition"),
        _conditions(achieves, "post-condition"),
        _several(uses),
        checked_meta(meta or {}),
        serial=serial,
        strict=strict,
        guard=guard,
    )

    def note(target: _Function) -> _Function:
        function: Any = getattr(target, "__func__", target)  # of a class or static method, its function has the mark
        if not inspect.isroutine(function):
            raise ConfigurationError(problem=f"@service decorates a method, not {target!r}")
        setattr(function, _MARK, mark)
        return target

    return note if function is None else note(function)


def require_check(where: str, check: object) -> None:
    """Raises ConfigurationError for what cannot be a guard's check."""
    if not callable(check) or inspect.iscoroutinefunction(check):
        problem = f"a guard is a plain function that returns why a call is refused, or None; not {check!r}"
        raise ConfigurationError(where=where, problem=problem)


def check_of(provider: object, name: str, mark: ServiceMark) -> Callable[[Any], Any] | None:
    """The check of a service's mark, bound to its provider as the service is."""
    if mark.guard is None or isinstance(inspect.getattr_static(type(provider), name), staticmethod):
        return mark.guard
    return functools.wraps(mark.guard)(functools.partial(mark.guard, provider))


def _several(texts: str | Sequence[str]) -> tuple[str, ...]:
    return (texts,) if isinstance(texts, str) else tuple(texts)


def _conditions(texts: str | Sequence[str], kind: str) -> tuple[str, ...]:
    several = _several(texts)
    for text in several:
        parse_condition(text, kind)
    return several


def marked_methods(cls: type, interfaces: Sequence[type] = ()) -> dict[str, tuple[ServiceMark, Callable[..., Any]]]:
    """The services of a class: from each name to its mark and the function with its signature.

    A mark on any class of the method resolution order, or on an interface named in addition, applies to the
    implementation. The most derived marked declaration gives the signature.
    """
    found: dict[str, tuple[ServiceMark, Callable[..., Any]]] = {}
    for owner in (*cls.__mro__, *(base for interface in interfaces for base in interface.__mro__)):
        for name, member in vars(owner).items():
            function: Any = getattr(member, "__func__", member)
            mark = getattr(function, _MARK, None)
            if isinstance(mark, ServiceMark) and name not in found:
                found[name] = (mark, function)
    _check(cls, found)
    return found


def effect_of(function: Callable[..., Any]) -> Effect | None:
    """The effect of a method, by its mark; None: it is not a service."""
    mark = getattr(function, _MARK, None)
    return mark.effect if isinstance(mark, ServiceMark) else None


def provider_of(given: object) -> object:
    """The provider of a function that is a service, one for each function; any other object is its own provider."""
    if not inspect.isfunction(given) or effect_of(given) is None:
        return given
    if _PROVIDER not in vars(given):
        setattr(given, _PROVIDER, type(given.__name__, (), {given.__name__: staticmethod(given)})())
    return vars(given)[_PROVIDER]


def kinds_of(cls: type, interfaces: Sequence[type] = ()) -> tuple[str, ...]:
    """Names of a class and of those of its bases and interfaces that have services."""
    every = (*cls.__mro__, *(base for interface in interfaces for base in interface.__mro__))
    serving = [base.__name__ for base in every if base is cls or any(map(_has_marks, base.__mro__))]
    return tuple(dict.fromkeys(serving))


def _has_marks(cls: type) -> bool:
    return any(
        isinstance(getattr(getattr(member, "__func__", member), _MARK, None), ServiceMark)
        for member in vars(cls).values()
    )


def _check(cls: type, found: dict[str, tuple[ServiceMark, Callable[..., Any]]]) -> None:
    lacking = [name for name in found if not _implements(cls, name)]
    if len(lacking) == 1:
        problem = "the interface has this service, but the class does not implement it"
        raise ConfigurationError(where=f"{cls.__qualname__}.{lacking[0]}", problem=problem)
    if lacking:
        problem = f"the interface has the services {', '.join(lacking)}, but the class does not implement them"
        raise ConfigurationError(where=cls.__qualname__, problem=problem)
    for name, (mark, _) in found.items():
        where = f"{cls.__qualname__}.{name}"
        if mark.cancel is not None and mark.cancel not in found:
            raise ConfigurationError(where=where, problem=f"cancel={mark.cancel!r} names no service of this class")


def _implements(cls: type, name: str) -> bool:
    """Whether the class implements a method: not abstract, and not the empty body of a protocol."""
    owner = next((base for base in cls.__mro__ if name in vars(base)), None)
    method = getattr(cls, name, None)
    return (
        owner is not None
        and not getattr(owner, "_is_protocol", False)
        and not getattr(method, "__isabstractmethod__", False)
        and callable(method)
    )
