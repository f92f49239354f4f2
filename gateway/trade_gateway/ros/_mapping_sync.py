"""Keeps mappings to ROS in step with TRADE's services: opens them for new services, and closes them for lost ones."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final, Literal, NamedTuple, Protocol

from trade import Constraint, Container, Handle, where
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Closable
from trade_gateway.ros_messages._conversion import failure

_logger = logging.getLogger("trade")

_OWN: Final = "trade"
"""Group of the middleware's own services, which are never mapped."""
_LOOK_EVERY_S: Final = 1.0
_ABSENT_S: Final = 5.0
"""The time after which a mapping without services is a problem, in seconds: a robot registers them one by one."""
_AGAIN_S: Final = 2.0
"""Pause before a failed mapping is retried, in seconds."""


class Place(NamedTuple):
    """The kind and name of a mapping in ROS."""

    kind: Literal["service", "action", "command", "topic"]
    """Except for topics, names are unique."""
    name: str
    what: str = ""
    """A description for people, if the mapping covers several services of TRADE."""


class Mapping(Protocol):
    """One entry of the file that maps services to ROS."""

    @property
    def of(self) -> Constraint:
        """The constraint of the services that it selects from."""
        ...

    @property
    def absent(self) -> tuple[str, str]:
        """Its group, and what that lacks if no service is selected: ``no gripper for action /grip``."""
        ...

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        """Pairs of places and services. Raises ConfigurationError: the selection is ambiguous."""
        ...

    def open(self, place: Place, handle: Handle) -> Closable:
        """Opens the mapping. Raises ConfigurationError: the types do not match."""
        ...


class _Key(NamedTuple):
    entry: int
    place: Place
    handle: Handle

    @property
    def what(self) -> str:
        """A description for people."""
        return self.place.what or self.handle.label


class Following:
    """Opens and closes mappings as services come and go.

    Args:
        container: its system has the services.
        mappings: the entries; the first one that wants a name gets it.
        say: receives one line for each mapping that opens, closes or fails.
    """

    def __init__(self, container: Container, mappings: Sequence[Mapping], say: Callable[[str], object]) -> None:
        self._container = container
        self._mappings = mappings
        self._say = say
        self._open: dict[_Key, Closable] = {}
        self._failed: dict[tuple[int, Place | None, Handle | None], tuple[str, float]] = {}
        """The reason and the time of each failure, by mapping."""
        self._absent: dict[int, float] = {}
        """Since when a mapping has found nothing in a group with services."""
        self._look_now = threading.Event()
        self._closing = False
        self._first = threading.Event()
        news = _ServiceChanges(self._look_now.set)
        self._notifications = [ask(where(), news.came) for ask in (container.joined, container.left, container.changed)]
        self._thread = threading.Thread(target=self._follow, name="trade-ros-following", daemon=True)
        self._thread.start()

    def settled(self, timeout_s: float) -> bool:
        """Waits until the mappings of present services are open. Returns whether they are."""
        return self._first.wait(timeout_s)

    def opened(self) -> dict[str, str]:
        """The TRADE service of each open mapping, by the kind and name of its ROS counterpart."""
        return {f"{key.place.kind} {key.place.name}": key.what for key in list(self._open)}

    def problems(self) -> list[str]:
        """The reasons of failed mappings."""
        return [text for text, _ in list(self._failed.values())]

    def _follow(self) -> None:
        while not self._closing:
            self._look_now.clear()
            try:
                self._look()
            except Exception:
                _logger.exception("the mappings to ROS could not be updated")
            self._first.set()
            self._look_now.wait(_LOOK_EVERY_S)

    def _look(self) -> None:
        wanted = self._wanted()
        for key in [key for key in self._open if key not in wanted]:
            self._open.pop(key).close()
            self._say(f"{key.place.kind} {key.place.name} is gone, because {key.what} is gone")
        present = {(key.entry, key.place, key.handle) for key in wanted}
        for failed in [one for one in self._failed if one[1] is not None and one not in present]:
            del self._failed[failed]
        for key in wanted:
            if key not in self._open and not self._closing:
                self._try(key)

    def _wanted(self) -> dict[_Key, None]:
        wanted: dict[_Key, None] = {}
        claimed = {key.place[:2]: key for key in self._open if key.place.kind != "topic"}
        for number, mapping in enumerate(self._mappings):
            found = [one for one in self._container.services(mapping.of) if self._is_for_ros(one)]
            try:
                places = list(mapping.places(found))
                self._note_absent(number, mapping, found=bool(places))
            except ConfigurationError as unclear:
                self._note((number, None, None), str(unclear))
                continue
            for place, handle in places:
                key = _Key(number, place, handle)
                holder = claimed.get(place[:2])
                if place.kind != "topic" and holder is not None and holder != key and holder.handle.alive:
                    self._note(key, f"{key.what} cannot be mapped to {place.name}: {holder.what} has this name")
                    continue
                if place.kind != "topic":
                    claimed[place[:2]] = key
                wanted[key] = None
        return wanted

    def _note_absent(self, number: int, mapping: Mapping, *, found: bool) -> None:
        """Notes a mapping that selects nothing, although its group has services: its kind or name may be wrong."""
        key, (group, what) = (number, None, None), mapping.absent
        if found or not group or not any(map(self._is_for_ros, self._container.services(where(group=group)))):
            self._absent.pop(number, None)
            self._failed.pop(key, None)
        elif time.monotonic() - self._absent.setdefault(number, time.monotonic()) >= _ABSENT_S:
            self._note(key, f"{group} has {what}")
        elif key in self._failed:
            del self._failed[key]

    def _is_for_ros(self, handle: Handle) -> bool:
        """Whether a service is not the bridge's own, as those came from ROS."""
        return handle.key.domain != _OWN and handle.key.address != self._container.address

    def _try(self, key: _Key) -> None:
        _, failed_at = self._failed.get(key, ("", -_AGAIN_S))
        if time.monotonic() - failed_at < _AGAIN_S:
            return
        try:
            self._open[key] = self._mappings[key.entry].open(key.place, key.handle)
        except Exception as error:  # noqa: BLE001 - a failed mapping must not prevent others
            self._note(key, f"{key.what} cannot be mapped to {key.place.name}: {failure(error)}")
            return
        self._failed.pop(key, None)
        self._say(f"{key.place.kind} {key.place.name} is {key.what}")

    def _note(self, key: tuple[int, Place | None, Handle | None], text: str) -> None:
        before, _ = self._failed.get(key, ("", 0.0))
        self._failed[key] = (text, time.monotonic())
        if text != before:
            self._say(text)

    def close(self) -> None:
        """Closes all mappings. Idempotent."""
        self._closing = True
        for each in self._notifications:
            each.cancel()
        self._look_now.set()
        self._thread.join()
        for key in list(self._open):
            self._open.pop(key).close()


class _ServiceChanges:
    """Receives notifications of services that come, go and change."""

    target_text = "update the mappings to ROS (the ROS bridge)"
    """Its text in lists of notifications."""

    def __init__(self, look: Callable[[], object]) -> None:
        self._look = look

    def came(self, _: Handle) -> None:
        self._look()


def absent_name(service: str, place: str) -> tuple[str, str]:
    """The group of a mapped service, and that it lacks this service."""
    group, _, name = service.rpartition(".")
    return group, f"no service {name} for {place}"


def of_name(service: str) -> Constraint:
    """The constraint that finds a mapped service: its group, if given, and its name."""
    group, _, name = service.rpartition(".")
    return where(group=group or None, name=name)


def named_services(service: str, found: Sequence[Handle]) -> list[Handle]:
    """Selects services by group and name; those of exactly this group have priority over those beneath it.

    Raises:
        ConfigurationError: there are several.
    """
    group, _, name = service.rpartition(".")
    inside = [handle for handle in found if handle.name == name]
    exact = [handle for handle in inside if group in (handle.key.domain, *handle.groups)] or inside
    if len(exact) > 1:
        several = ", ".join(f"{one.label} in {one.container}" for one in exact)
        raise ConfigurationError(where=service, problem=f"is ambiguous. There is {several}")
    return exact
