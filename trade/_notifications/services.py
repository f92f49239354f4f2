"""The services for notifications that every container offers, in group ``trade``."""

import contextlib
import logging
import threading
from collections.abc import Callable

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import served_call
from trade._context.sessions import Session
from trade._notifications.notification import ActiveNotification, Notification, NotificationInfo, Owner
from trade._notifications.notifier import Notifier
from trade._notifications.triggers import OF_SERVICES, Action, TriggerSpec
from trade._registry.registry import Record, Registry
from trade._services.decorator import service
from trade.errors import CallerError, CallError, NoSuchNotification
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey

_logger = logging.getLogger("trade")


class OwnerSessions:
    """Sessions for the owners of notifications in this container: what one's calls move stops with its session."""

    def __init__(self, open_session: Callable[[str], Session]) -> None:
        self._open = open_session
        self._lock = threading.Lock()
        self._sessions: dict[str, Session] = {}

    def of(self, owner: str) -> Session:
        with self._lock:
            known = self._sessions.get(owner)
            if known is None:
                parts = owner.split("/")
                known = self._sessions[owner] = self._open(f"for.{parts[0]}.{parts[1] if len(parts) > 1 else ''}")
            return known

    def leave(self, owner: str) -> None:
        with self._lock:
            known = self._sessions.pop(owner, None)
        if known is not None:
            known.close()


class NotificationServices:
    """Keeps notifications in this container for owners in others, and lists, ends and detaches them."""

    def __init__(self, notifier: Notifier, client: CallClient, open_session: Callable[[str], Session]) -> None:
        self._notifier = notifier
        self._client = client
        self._guests = OwnerSessions(open_session)
        notifier.failed = self._notify_owner
        notifier.ended = self._guests.leave

    @service
    def notify(self, terms: TriggerSpec, call: Action, if_: Action | None = None, when: Action | None = None) -> str:
        """Make a call when an event occurs, for the caller, who must then have the right to make it; returns the id."""
        asked, given = served_call(), (call, if_, when)
        handles = (one.handle for one in given if one is not None)
        self._client.registry.wait_until_known(handle.key for handle in handles if handle is not None)
        owner = Owner(asked.session, asked.caller, self._guests.of(asked.session))
        try:
            return placed(self._notifier, self._client.registry, terms, call, if_, when, owner).id
        finally:
            self._notifier.tidy(asked.session)

    @service(effect="read")
    def notifications(self) -> list[NotificationInfo]:
        """The notifications in this container, of all owners."""
        return self._notifier.infos()

    @service
    def cancel_notification(self, notification: str) -> bool:
        """End a notification in this container; returns whether it existed. Another owner's requires ``administer``."""
        active = self._mine_or_administered(notification)
        if active is not None:
            active.cancel()
        return active is not None

    @service
    def detach_notification(self, notification: str) -> None:
        """Let a notification in this container outlive its owner."""
        active = self._mine_or_administered(notification)
        if active is None:
            raise NoSuchNotification(id=notification)
        active.detach()

    @service
    def notification_failed(self, notification: str, text: str, error: str) -> None:
        """For containers: a call that another container makes for this one failed."""
        _logger.warning(
            "the call of %s (%s), requested here, failed at %s: %s", notification, text, served_call().caller, error
        )

    def _mine_or_administered(self, notification: str) -> ActiveNotification | None:
        active, asked = self._notifier.get(notification), served_call()
        if active is not None and (active.owner.identity or self._client.address.identity) != asked.caller:
            self._client.access.require(asked.caller, "administer", DOMAIN, f"notification {notification}")
        return active

    def _notify_owner(self, active: ActiveNotification, error: str) -> None:
        owner = Address(*active.owner.session.split("/")[:3])
        with contextlib.suppress(CallerError, CallError):  # the owner has gone
            failed = self._client.handle(ServiceKey(owner, DOMAIN, PROVIDER, "notification_failed"))
            failed.start(active.id, str(active.terms), error)


def placed(
    notifier: Notifier,
    registry: Registry,
    terms: TriggerSpec,
    call: Action | Callable[..., object],
    if_: Action | Callable[..., object] | None,
    when: Action | Callable[..., object] | None,
    owner: Owner,
) -> ActiveNotification:
    """Start a notification such that it misses no change of the registry and reports none twice."""
    made: list[ActiveNotification] = []

    def add() -> None:
        existing: list[Record] = []
        if terms.occasion in OF_SERVICES and terms.existing and terms.constraint is not None:
            existing = registry.select(terms.constraint)
        made.append(notifier.add(terms, call, if_, when, owner, existing))

    registry.between_changes(add)
    return made[0]


class Hosted(Notification):
    """A notification that runs in another container."""

    def __init__(self, name: str, terms: TriggerSpec, host: Address, handle: Callable[[ServiceKey], Handle]) -> None:
        super().__init__(name, f"{terms}, in {host.container}")
        self._host = host
        self._handle = handle

    def _service(self, name: str) -> Handle:
        return self._handle(ServiceKey(self._host, DOMAIN, PROVIDER, name))

    def info(self) -> NotificationInfo:
        for info in self._service("notifications")():
            if info.id == self.id:
                return info
        raise NoSuchNotification(id=self.id)

    @property
    def active(self) -> bool:
        try:
            self.info()
        except NoSuchNotification:
            return False
        return True

    def cancel(self) -> None:
        self._service("cancel_notification")(self.id)

    def detach(self) -> None:
        self._service("detach_notification")(self.id)
