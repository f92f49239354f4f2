"""The notifications of one container, for itself and for others."""

import threading
from collections.abc import Callable
from typing import Final

from trade._calls.client import CallClient
from trade._notifications.events import StateEvent
from trade._notifications.notification import ActiveNotification, NotificationInfo, Owner
from trade._notifications.triggers import OF_CHANGES, Target, TriggerSpec
from trade._registry.registry import Change, Record
from trade._threads.scheduler import Scheduler
from trade.errors import ConfigurationError

_MOST: Final = 10_000
"""The largest number of notifications in a container for others."""


class Notifier:
    """Owns the notifications of one container, for itself and for others."""

    def __init__(self, client: CallClient, scheduler: Scheduler) -> None:
        self._client = client
        self._scheduler = scheduler
        self._lock = threading.Lock()
        self._notifications: dict[str, ActiveNotification] = {}
        self._of_changes: dict[str, tuple[ActiveNotification, Callable[[int], None]]] = {}
        self._count = 0
        self.failed: Callable[[ActiveNotification, str], None] = lambda _notification, _error: None
        """Called for each failure of a notification of another container."""
        self.ended: Callable[[str], None] = lambda _session: None
        """Called when a session of another container has no notification here any more."""

    def add(
        self,
        terms: TriggerSpec,
        call: Target,
        if_: Target | None,
        when: Target | None,
        owner: Owner,
        existing: list[Record],
    ) -> ActiveNotification:
        """Start a notification; it first reports matching services that exist already.

        Raises:
            ConfigurationError: an invalid time, or too many notifications for others.
        """
        terms.check()
        with self._lock:
            if owner.identity and len(self._notifications) >= _MOST:
                problem = f"{len(self._notifications)} notifications are active here already"
                raise ConfigurationError(where=self._client.name, problem=problem)
            self._count += 1
            name = f"{self._client.address.epoch}.{self._count}"
            notification = ActiveNotification(
                name, terms, call, if_, when, owner, self._client, self._forget, self._failed
            )
            self._notifications[name] = notification
            for record in existing:
                notification.add(self._client.handle_of(record))
            again = notification.begin(self._scheduler)
            if terms.occasion in OF_CHANGES:
                self._of_changes[name] = (notification, again)
        return notification

    def _failed(self, notification: ActiveNotification, error: str) -> None:
        if notification.owner.identity:
            self.failed(notification, error)

    def _forget(self, notification: ActiveNotification) -> None:
        with self._lock:
            self._notifications.pop(notification.id, None)
            self._of_changes.pop(notification.id, None)
        if notification.owner.identity:
            self.tidy(notification.owner.session)

    def tidy(self, session: str) -> None:
        """Check whether a session still has notifications here."""
        with self._lock:
            left = any(one.owner.session == session for one in self._notifications.values())
        if not left:
            self.ended(session)

    def changed(self, change: Change) -> None:
        """Called by the registry."""
        with self._lock:
            active = list(self._of_changes.values())
        now = self._scheduler.clock.now_ns()
        for notification, again in active:
            concerned = _concerned(notification, change)
            for record in concerned:
                notification.add(self._client.handle_of(record))
            if concerned:
                again(now)

    def occurred(self, event: StateEvent, record: Record | None) -> None:
        """A state of this container has changed; the record is the service that the event is about, if any."""
        with self._lock:
            active = [one for one in self._of_changes.values() if event.kind in one[0].terms.events]
        now = self._scheduler.clock.now_ns()
        for notification, again in active:
            wanted = notification.terms.constraint
            if wanted is None or (record is not None and wanted.matches(record)):
                notification.add(event)
                again(now)

    def session_ended(self, session: str) -> None:
        """End the notifications of a session that ended, except detached ones."""
        with self._lock:
            orphans = [one for one in self._notifications.values() if one.owner.session == session and not one.detached]
        for notification in orphans:
            notification.cancel()
        self.tidy(session)

    def get(self, name: str) -> ActiveNotification | None:
        return self._notifications.get(name)

    def infos(self) -> list[NotificationInfo]:
        """The notifications of this container, oldest first."""
        with self._lock:
            notifications = list(self._notifications.values())
        return [one.info() for one in notifications]

    def close(self) -> None:
        """End all. Idempotent."""
        with self._lock:
            notifications = list(self._notifications.values())
        for one in notifications:
            one.cancel()


def _concerned(notification: ActiveNotification, change: Change) -> list[Record]:
    match notification.terms.occasion:
        case "joined":
            return [record for record in change.joined if notification.concerns(record)]
        case "left":
            return [record for record in change.left if notification.concerns(record)]
        case "occurred":
            return []
        case _:
            altered = [(old, new) for old, new in zip(change.before, change.replaced, strict=True) if old != new]
            return [new for old, new in altered if notification.concerns(old) or notification.concerns(new)]
