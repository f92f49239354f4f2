"""What of ours ROS has, as providers come and go: opened when a service is there, closed when it is gone."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple, Protocol

from trade import Constraint, Container, Handle, where
from trade.errors import ConfigurationError
from trade_gateway.ros._conversion import failure
from trade_gateway.ros._graph import Closes

__all__ = ["Following", "Mapping", "Place", "named_services", "of_name"]

_logger = logging.getLogger("trade")

_OWN: Final = "trade"
"""Group of the middleware's own functions: for nobody in ROS."""
_LOOK_EVERY_S: Final = 1.0
_AGAIN_S: Final = 2.0
"""After which what could not be opened is tried again."""


class Place(NamedTuple):
    """Where something is in ROS."""

    kind: str
    """``service``, ``action``, ``command`` or ``topic``; of all but the last there is one of a name."""
    name: str
    what: str = ""
    """For people, if it is more than one service of ours."""


class Mapping(Protocol):
    """One entry of the file, for ROS to have."""

    @property
    def of(self) -> Constraint:
        """Among which services it looks."""
        ...

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        """Where which of those go. Raises ConfigurationError: it is not clear which is meant."""
        ...

    def open(self, place: Place, handle: Handle) -> Closes:
        """Have it there. Raises ConfigurationError: it does not fit."""
        ...


class _Key(NamedTuple):
    entry: int
    place: Place
    handle: Handle

    @property
    def what(self) -> str:
        """What is there, for people."""
        return self.place.what or self.handle.label


class Following:
    """Keeps open what can be.

    Args:
        container: whose system.
        mappings: the entries; of two that want the same name the first has it.
        say: told in a line what comes up, goes, or cannot be.
    """

    def __init__(self, container: Container, mappings: Sequence[Mapping], say: Callable[[str], object]) -> None:
        self._container = container
        self._mappings = mappings
        self._say = say
        self._open: dict[_Key, Closes] = {}
        self._failed: dict[tuple[int, Place | None, Handle | None], tuple[str, float]] = {}
        """Why, and when."""
        self._look_now = threading.Event()
        self._closing = False
        self._first = threading.Event()
        hear = _Heard(self._look_now.set)
        self._told = [ask(where(), hear.told) for ask in (container.joined, container.left, container.changed)]
        self._thread = threading.Thread(target=self._follow, name="trade-ros-following", daemon=True)
        self._thread.start()

    def settled(self, timeout_s: float) -> bool:
        """Wait until what is there already was opened. Returns whether it was."""
        return self._first.wait(timeout_s)

    def opened(self) -> dict[str, str]:
        """What is open, by kind and name: what it is here."""
        return {f"{key.place.kind} {key.place.name}": key.what for key in list(self._open)}

    def problems(self) -> list[str]:
        """What is not, and why."""
        return [text for text, _ in list(self._failed.values())]

    def _follow(self) -> None:
        while not self._closing:
            self._look_now.clear()
            try:
                self._look()
            except Exception:
                _logger.exception("what ROS has of ours could not be brought up to date")
            self._first.set()
            self._look_now.wait(_LOOK_EVERY_S)

    def _look(self) -> None:
        wanted = self._wanted()
        for key in [key for key in self._open if key not in wanted]:
            self._open.pop(key).close()
            self._say(f"{key.place.kind} {key.place.name} is gone, as {key.what} is")
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
                self._failed.pop((number, None, None), None)
            except ConfigurationError as unclear:
                self._note((number, None, None), str(unclear))
                continue
            for place, handle in places:
                key = _Key(number, place, handle)
                holder = claimed.get(place[:2])
                if place.kind != "topic" and holder is not None and holder != key and holder.handle.alive:
                    self._note(key, f"{key.what} is not there as {place.name}, which {holder.what} is")
                    continue
                if place.kind != "topic":
                    claimed[place[:2]] = key
                wanted[key] = None
        return wanted

    def _is_for_ros(self, handle: Handle) -> bool:
        """What the bridge itself offers came from ROS."""
        return handle.key.domain != _OWN and handle.key.address != self._container.address

    def _try(self, key: _Key) -> None:
        _, failed_at = self._failed.get(key, ("", -_AGAIN_S))
        if time.monotonic() - failed_at < _AGAIN_S:
            return
        try:
            self._open[key] = self._mappings[key.entry].open(key.place, key.handle)
        except Exception as error:  # noqa: BLE001 - one that cannot be mapped keeps no other from it
            self._note(key, f"{key.what} is not there as {key.place.name}: {failure(error)}")
            return
        self._failed.pop(key, None)
        self._say(f"{key.place.kind} {key.place.name} is {key.what}")

    def _note(self, key: tuple[int, Place | None, Handle | None], text: str) -> None:
        before, _ = self._failed.get(key, ("", 0.0))
        self._failed[key] = (text, time.monotonic())
        if text != before:
            self._say(text)

    def close(self) -> None:
        """Close all. Idempotent."""
        self._closing = True
        for told in self._told:
            told.cancel()
        self._look_now.set()
        self._thread.join()
        for key in list(self._open):
            self._open.pop(key).close()


class _Heard:
    """Hears of services that come, go and change."""

    told_as = "look what ROS has (the ROS bridge)"
    """In lists of notifications."""

    def __init__(self, look: Callable[[], object]) -> None:
        self._look = look

    def told(self, _: Handle) -> None:
        self._look()


def of_name(service: str) -> Constraint:
    """What a mapped service is found by: its group, if it names one, and its name."""
    group, _, name = service.rpartition(".")
    return where(group=group or None, name=name)


def named_services(service: str, found: Sequence[Handle]) -> list[Handle]:
    """Of some services the one of a group and name; one of exactly this group goes before those beneath it.

    Raises:
        ConfigurationError: there are several.
    """
    group, _, name = service.rpartition(".")
    inside = [handle for handle in found if handle.name == name]
    exact = [handle for handle in inside if group in (handle.key.domain, *handle.groups)] or inside
    if len(exact) > 1:
        several = ", ".join(f"{one.label} in {one.container}" for one in exact)
        raise ConfigurationError(where=service, problem=f"which one? There is {several}")
    return exact
