"""The questions: each makes calls and look-ups that any program could make, and returns their result."""

import contextlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
from msgspec import Struct

from trade import Container, Handle, where
from trade._protocol.messages import HEALTHY, UNREADABLE
from trade._timestamps import clock
from trade.errors import ConfigurationError
from trade_gateway.process._atomic_file import replace

__all__ = ["QUESTIONS", "Answer", "Memory", "Question", "Unknown"]

_MOST_BYTES: Final = 16 << 20


class Memory:
    """The services at the last look and their containers, in a file or in this object only.

    Args:
        path: the file, which need not exist; None: nothing is stored.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._known: Mapping[str, str] | None = None if path is None else _read(path)

    def news(self, services: Mapping[str, str]) -> tuple[list[str], list[str]] | None:
        """Returns the services that joined and left since the last look; None at the first one.

        Args:
            services: the present services, and the container of each.
        """
        before, self._known = self._known, dict(services)
        if self._path is not None:
            with contextlib.suppress(OSError):  # an unsaved change is reported again
                self._path.parent.mkdir(parents=True, exist_ok=True)
                replace(self._path, msgspec.json.encode(self._known), 0o600)
        if before is None:
            return None
        came = sorted(label for label, container in services.items() if before.get(label) != container)
        return came, sorted(label for label in before if label not in services)


def _read(path: Path) -> dict[str, str] | None:
    try:
        with path.open("rb") as file:
            return msgspec.json.decode(file.read(_MOST_BYTES), type=dict[str, str])
    except (OSError, *UNREADABLE):  # a damaged file counts as none
        return None


_SPLIT: Final = re.compile(r"[\s._]+")
_NAMED: Final = 12
"""Further names are only counted."""


class Unknown(Exception):
    """Nothing has that name; the text lists what exists."""


class Answer(Struct, frozen=True):
    """The result of a question."""

    count: int
    fields: Mapping[str, object]
    """The parts of the answer."""
    data: Any
    """The same for programs."""


class Question(NamedTuple):
    """A question that can be asked."""

    gaps: tuple[str, ...]
    """Its gaps."""
    fields: tuple[str, ...]
    """The parts of its answer."""
    ask: Callable[[Container, Memory, Mapping[str, str]], Answer]
    is_order: bool = False
    """Whether it acts on the system."""


def _services(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    found = _matching(container, gaps)
    return _names(sorted({handle.label for handle in found}))


def _containers(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    host = _one_of("host", gaps.get("host"), [handle.host for handle in _others(container)])
    infos = [info for info in container.containers() if info.epoch != container.address.epoch]
    return _names(sorted(info.name for info in infos if host in ("", info.host)))


def _hosts(container: Container, _: Memory, _gaps: Mapping[str, str]) -> Answer:
    return _names(sorted({info.host for info in container.containers() if info.epoch != container.address.epoch}))


def _place(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    found = _matching(container, gaps)
    places = sorted({(handle.container, handle.host) for handle in found})
    said = _said([f"container {name} on host {host}" for name, host in places])
    return Answer(
        len(places),
        {"count": len(places), "places": said},
        [{"container": name, "host": host} for name, host in places],
    )


def _able(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    goal = gaps["goal"]
    try:
        found = container.services(where(achieves=goal if "(" in goal else f"{_SPLIT.sub('_', goal)}(?x)"))
    except ConfigurationError as bad:
        raise Unknown(f"{goal!r} is not a predicate such as see(?x): {bad.problem}") from None
    return _names(sorted({handle.label for handle in found}))


def _description(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    found = {handle.signature: handle for handle in _matching(container, gaps)}
    said = "; ".join(f"{handle.label} is {sign}: {handle.doc or 'undocumented'}" for sign, handle in found.items())
    data = [{"service": handle.label, "signature": sign, "doc": handle.doc} for sign, handle in found.items()]
    return Answer(len(found), {"count": len(found), "descriptions": said}, data)


def _locks(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    names = {name for handle in _matching(container, gaps) for name in handle.resources}
    known = container.locking.known()
    held = [info for info in known.locks if not gaps or not names.isdisjoint(info.resources)]
    said = [
        f"{info.holder.owner} has {', '.join(info.resources)}"
        + (f", for {info.holder.purpose!r}" if info.holder.purpose else "")
        + f", since {clock(info.holder.since)}"
        + (f"; {', '.join(info.waiting)} waits" if info.waiting else "")
        for info in held
    ]
    said += [f"of {silent.container} it is not known, it does not answer" for silent in known.silent]
    data = [{"owner": info.holder.owner, "resources": info.resources, "purpose": info.holder.purpose} for info in held]
    return Answer(len(said), {"count": len(held), "locks": "; ".join(said)}, data)


def _unwell(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    bad = {(handle.groups or (handle.label,))[0]: handle.health for handle in _matching(container, gaps)}
    bad = {group: health for group, health in bad.items() if health != HEALTHY}
    stopped = [
        f"an e-stop is open, by {one.giver}{f': {one.reason}' if one.reason else ''}" for one in container.estops()
    ]
    said = [*stopped, *(f"{group}: {health}" for group, health in sorted(bad.items()))]
    return Answer(len(said), {"count": len(said), "problems": "; ".join(said)}, said)


def _news(container: Container, memory: Memory, _gaps: Mapping[str, str]) -> Answer:
    news = memory.news({handle.label: handle.container for handle in _others(container)})
    if news is None:
        return Answer(1, {"count": 1, "news": "I have not looked before; from now on I know"}, None)
    came, gone = news
    said = [f"{word}: {_said(labels)}" for word, labels in (("new", came), ("gone", gone)) if labels]
    count = len(came) + len(gone)
    return Answer(count, {"count": count, "news": "; ".join(said)}, {"came": came, "gone": gone})


def _load(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    asked = container.services(where(name="load", group="trade") & ~where.local)
    name = _one_of("container", gaps.get("container"), [handle.container for handle in asked])
    asked = [handle for handle in asked if name in ("", handle.container)]
    infos = [outcome.result for outcome in container.call_all(asked) if outcome.ok]
    infos.sort(key=lambda info: -info.cpu_percent)
    said = [f"{info.container} takes {info.cpu_percent:.0f} % of a core" for info in infos]
    busiest = infos[0].container if infos else ""
    return Answer(len(infos), {"count": len(infos), "loads": "; ".join(said), "busiest": busiest}, infos)


def _estop(container: Container, _: Memory, gaps: Mapping[str, str]) -> Answer:
    report = container.estop(gaps.get("reason", "requested in a sentence"))
    troubles = [f"{name} did not answer" for name in report.missing]
    troubles += [f"{name} failed: {why}" for name, why in report.failed.items()]
    said = f"confirmed by {_said(list(report.confirmed)) or 'none'}{'; ' if troubles else ''}{'; '.join(troubles)}"
    return Answer(len(report.confirmed), {"count": len(report.confirmed), "report": said, "id": report.id}, report)


_WHICH: Final = ("group", "service", "container", "host")

QUESTIONS: Final[Mapping[str, Question]] = {
    "services": Question(_WHICH, ("count", "names"), _services),
    "containers": Question(("host",), ("count", "names"), _containers),
    "hosts": Question((), ("count", "names"), _hosts),
    "place": Question(_WHICH, ("count", "places"), _place),
    "able": Question(("goal",), ("count", "names"), _able),
    "description": Question(_WHICH, ("count", "descriptions"), _description),
    "locks": Question(_WHICH, ("count", "locks"), _locks),
    "unwell": Question(_WHICH, ("count", "problems"), _unwell),
    "news": Question((), ("count", "news"), _news),
    "load": Question(("container",), ("count", "loads", "busiest"), _load),
    "estop": Question(("reason",), ("count", "report", "id"), _estop, is_order=True),
}
"""Questions and orders by their names in the lexicon."""


def _others(container: Container) -> list[Handle]:
    """All services except the middleware's own and those of this container."""
    return container.services(~where(group="trade") & ~where.local)


def _matching(container: Container, gaps: Mapping[str, str]) -> list[Handle]:
    """The services that match the gaps. Raises Unknown."""
    found = _others(container)
    if host := _one_of("host", gaps.get("host"), [handle.host for handle in found]):
        found = [handle for handle in found if handle.host == host]
    if name := _one_of("container", gaps.get("container"), [handle.container for handle in found]):
        found = [handle for handle in found if handle.container == name]
    if "service" in gaps:
        found = _ending(gaps["service"], found, lambda handle: [handle.label], "service")
    if "group" in gaps:
        found = _ending(gaps["group"], found, _groups, "group")
    return found


def _groups(handle: Handle) -> list[str]:
    """The groups of a service, and those above them."""
    return [group[:end] for group in handle.groups for end in _ends(group)]


def _ends(group: str) -> list[int]:
    return [at for at, letter in enumerate(group) if letter == "."] + [len(group)]


def _ending(said: str, handles: Sequence[Handle], names: Callable[[Handle], Iterable[str]], kind: str) -> list[Handle]:
    """Services whose name ends in these words: the legs are ``rosie.legs``, the left arm is ``rosie.left.arm``."""
    words = [word for word in _SPLIT.split(said.lower().removesuffix("'s")) if word not in ("", "the", "a", "an")]
    found = _with(words, handles, names)
    if words and not found and words[-1].endswith("s"):  # "the cameras" also matches each camera
        found = _with([*words[:-1], words[-1][:-1]], handles, names)
    if not found:
        known = sorted({name for handle in handles for name in names(handle)})
        raise Unknown(f"I know no {kind} {said!r}; there is {_said(known) or 'none'}")
    return found


def _with(words: list[str], handles: Sequence[Handle], names: Callable[[Handle], Iterable[str]]) -> list[Handle]:
    return [
        handle for handle in handles if words and any(_words(name)[-len(words) :] == words for name in names(handle))
    ]


def _words(name: str) -> list[str]:
    return [word for word in _SPLIT.split(name.lower()) if word]


def _one_of(kind: str, said: str | None, known: Iterable[str]) -> str:
    """The name with the right spelling; empty if the gap is. Raises Unknown."""
    if said is None:
        return ""
    names = sorted(set(known))
    for name in names:
        if name.lower() == said.lower():
            return name
    raise Unknown(f"I know no {kind} {said!r}; there is {_said(names) or 'none'}")


def _names(names: Sequence[str]) -> Answer:
    return Answer(len(names), {"count": len(names), "names": _said(names)}, list(names))


def _said(names: Sequence[str]) -> str:
    shown = names if len(names) <= _NAMED else names[: _NAMED - 2]
    return ", ".join(shown) + (f" and {len(names) - len(shown)} more" if len(names) > len(shown) else "")
