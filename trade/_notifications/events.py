"""Events of a container's own state: its links, switches, hooks and listeners, and calls that deviate."""

import threading
import time
from collections import deque
from typing import Final, Literal, get_args

from msgspec import Struct

from trade._registry.registry import Record
from trade._threads.event import Event

EventKind = Literal[
    "container_joined",
    "container_left",
    "linked",
    "unlinked",
    "discovery",
    "broadcast",
    "certificate_ends",
    "hook_suspended",
    "listener_joined",
    "listener_left",
    "call_deviated",
    "rule_fired",
    "rule_stopped",
]
EVENT_KINDS: Final[frozenset[str]] = frozenset(get_args(EventKind))
_MOST: Final = 500
"""The number of events that a container keeps: the newest."""


class StateEvent(Struct, frozen=True, kw_only=True):
    """One change of a state."""

    number: int
    """Counted from 1 in the container that reports it."""
    at: float
    """``time.time()`` of that container's host."""
    kind: str
    """One of `EVENT_KINDS`. ``discovery`` and ``broadcast``: it was switched. The other names say what happened."""
    container: str
    """The container that reports it."""
    about: str
    """What changed: a container, a service, the id of a hook, the name of a rule, or an identity."""
    text: str = ""
    """Further details, for people."""


class EventLog:
    """Keeps the newest events of one container, and reports each."""

    def __init__(self, container: str) -> None:
        self._container = container
        self._lock = threading.Lock()
        self._events: deque[StateEvent] = deque(maxlen=_MOST)
        self._noted = 0
        self.occurred: Final = Event[tuple[StateEvent, Record | None]]()
        """Emitted with each event, and the service that it is about, if any."""

    def note(self, kind: EventKind, about: str, text: str = "", record: Record | None = None) -> None:
        """Add an event."""
        with self._lock:
            self._noted += 1
            event = StateEvent(
                number=self._noted, at=time.time(), kind=kind, container=self._container, about=about, text=text
            )
            self._events.append(event)
        self.occurred.emit((event, record))

    def after(self, number: int) -> list[StateEvent]:
        """The events after a number, oldest first."""
        with self._lock:
            return [event for event in self._events if event.number > number]
