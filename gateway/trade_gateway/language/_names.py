"""Names in sentences: the services, groups, containers and hosts that some words mean."""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from trade import Container, ContainerInfo, Handle, where
from trade_gateway.language._requests import Ambiguous, Answer, Gaps, Requester, Unknown

__all__ = ["Place", "groups_named", "matching", "names", "one_container", "one_group", "one_of", "others", "place"]
__all__ += ["in_words", "provider_of", "resources"]

_SPLIT: Final = re.compile(r"[\s._]+")
_SPLIT_WIDE: Final = re.compile(r"[\s._-]+")
_KIND: Final = re.compile(r"(?:the )?(container|host|computer|machine) (?=\S)", re.IGNORECASE)
_KIND_AFTER: Final = re.compile(r"(?<=\S) (container|host|computer|machine)$", re.IGNORECASE)
_NAMED: Final = 12
"""Further names are only counted."""


class Place(NamedTuple):
    """A container, a host, or the whole system."""

    text: str
    """``container base``, ``host base``; empty: everywhere."""
    containers: tuple[ContainerInfo, ...]
    """Its containers, without the asking one."""


# --- services and groups


def others(container: Container) -> list[Handle]:
    """All services except the middleware's own and those of this container."""
    return container.services(~where(group="trade") & ~where.local)


def matching(container: Container, gaps: Gaps) -> list[Handle]:
    """The services that match the gaps. Raises Unknown."""
    found = others(container)
    if host := one_of("host", gaps.get("host"), [handle.host for handle in found]):
        found = [handle for handle in found if handle.host == host]
    if name := one_of("container", gaps.get("container"), [handle.container for handle in found]):
        found = [handle for handle in found if handle.container == name]
    if "service" in gaps:
        found = _ending(gaps["service"], found, lambda handle: [handle.label], "service")
    if "group" in gaps:
        found = _ending(gaps["group"], found, _groups, "group")
    return found


def groups_named(requester: Requester, words: str) -> list[str]:
    """The whole names of the groups that these words mean. Raises Unknown."""
    found = _ending(words, others(requester.container), _groups, "group")
    every = sorted({group for handle in found for group in _groups(handle)})
    if words.lower() in every:
        return [words.lower()]
    fits = ([group for group in every if _words(group)[-len(form) :] == form] for form in _forms(words))
    return next(filter(None, fits), every)


def one_group(requester: Requester, words: str) -> str:
    """The group that these words mean. Raises Unknown, Ambiguous."""
    found = groups_named(requester, words)
    if len(found) > 1:
        raise Ambiguous("group", found)
    return found[0]


def provider_of(requester: Requester, words: str) -> Handle:
    """A service of the only provider that these words mean. Raises Unknown, Ambiguous."""
    group = one_group(requester, words)
    found = [handle for handle in others(requester.container) if group in _groups(handle)]
    providers = {(handle.key.address, handle.key.domain, handle.key.provider): handle for handle in found}
    if len(providers) == 1:
        return found[0]
    groups = sorted({name for handle in providers.values() for name in handle.groups})
    if len(groups) > 1:
        raise Ambiguous("group", groups)
    where_ = in_words(sorted(f"one in container {handle.container}" for handle in providers.values()))
    raise Unknown(f"{group} has {len(providers)} providers, {where_}. `trade migrate` takes the name of one of them")


def resources(handles: Iterable[Handle]) -> set[str]:
    """The resources of services; one that names none has its own."""
    return {name for handle in handles for name in handle.record.used}


def _groups(handle: Handle) -> list[str]:
    """The groups of a service, and those above them."""
    return [group[:end] for group in handle.groups for end in _ends(group)]


def _ends(group: str) -> list[int]:
    return [at for at, letter in enumerate(group) if letter == "."] + [len(group)]


def _ending(words: str, handles: Sequence[Handle], named: Callable[[Handle], Iterable[str]], kind: str) -> list[Handle]:
    """Services whose name ends in these words: the legs are ``rosie.legs``, the left arm is ``rosie.left.arm``."""
    for form in _forms(words):
        if found := _with(form, handles, named):
            return found
    known = sorted({name for handle in handles for name in named(handle)})
    raise Unknown(f"I know no {kind} {words!r}; there is {in_words(known) or 'none'}")


def _forms(text: str) -> list[list[str]]:
    words = [word for word in _SPLIT.split(text.lower().removesuffix("'s")) if word not in ("", "the", "a", "an")]
    if words and words[-1].endswith("s"):  # "the cameras" also matches each camera
        return [words, [*words[:-1], words[-1][:-1]]]
    return [words] if words else []


def _with(words: list[str], handles: Sequence[Handle], named: Callable[[Handle], Iterable[str]]) -> list[Handle]:
    return [handle for handle in handles if any(_words(name)[-len(words) :] == words for name in named(handle))]


def _words(name: str) -> list[str]:
    return [word for word in _SPLIT.split(name.lower()) if word]


# --- containers and hosts


def place(requester: Requester, words: str | None) -> Place:
    """The containers that some words mean; all, without words. Raises Unknown, Ambiguous."""
    own = requester.container.address.epoch
    infos = sorted((info for info in requester.container.containers() if info.epoch != own), key=lambda info: info.name)
    if words is None:
        return Place("", tuple(infos))
    kind = _KIND.match(words) or _KIND_AFTER.search(words)
    bare = words if kind is None else words[: kind.start()] + words[kind.end() :]
    found: list[Place] = []
    if kind is None or kind[1].lower() == "container":
        found += [Place(f"container {info.name}", (info,)) for info in infos if _fits(info.name, bare)]
    if kind is None or kind[1].lower() != "container":
        hosts = sorted({info.host for info in infos if _fits(info.host, bare)})
        found += [Place(f"host {host}", tuple(info for info in infos if info.host == host)) for host in hosts]
    exact = [one for one in found if one.text.partition(" ")[2].lower() == bare.lower()]
    found = exact or found
    if not found:
        known = {f"container {info.name}" for info in infos} | {f"host {info.host}" for info in infos}
        raise Unknown(f"I know no container or host {words!r}; there is {in_words(sorted(known)) or 'none'}")
    if len({one.containers for one in found}) > 1:
        raise Ambiguous("place", [one.text for one in found])
    return found[0]


def one_container(requester: Requester, words: str | None, without: str = "") -> ContainerInfo:
    """The only container of a place, except one. Raises Unknown, Ambiguous."""
    there = place(requester, words)
    found = [info for info in there.containers if info.name != without]
    if len(found) == 1:
        return found[0]
    if not found:
        raise Unknown(f"there is no {'other ' if without else ''}container{f' on {there.text}' if there.text else ''}")
    raise Ambiguous("place", [f"container {info.name}" for info in found])


def _fits(name: str, words: str) -> bool:
    """Whether a name ends in these words: the camera driver is ``camera-driver``."""
    asked, parts = _SPLIT_WIDE.split(words.lower()), _SPLIT_WIDE.split(name.lower())
    return name.lower() == words.lower() or parts[-len(asked) :] == asked


def one_of(kind: str, words: str | None, known: Iterable[str]) -> str:
    """The name with the right spelling; empty if the gap is. Raises Unknown."""
    if words is None:
        return ""
    every = sorted(set(known))
    for name in every:
        if name.lower() == words.lower():
            return name
    raise Unknown(f"I know no {kind} {words!r}; there is {in_words(every) or 'none'}")


# --- in answers


def names(every: Sequence[str]) -> Answer:
    """An answer that is a list of names."""
    return Answer(len(every), {"count": len(every), "names": in_words(every)}, list(every))


def in_words(every: Sequence[str]) -> str:
    """Names as text; if there are many, the first ones and the number of the others."""
    shown = every if len(every) <= _NAMED else every[: _NAMED - 2]
    return ", ".join(shown) + (f" and {len(every) - len(shown)} more" if len(every) > len(shown) else "")
