"""The notification methods of a container: when an event occurs and a condition holds, make a call."""

import time
from collections.abc import Sequence
from datetime import datetime
from typing import Final

from trade._calls.client import CallClient
from trade._context.sessions import speaking
from trade._notifications.events import EventKind
from trade._notifications.notification import Notification, NotificationInfo, Owner
from trade._notifications.notifier import Notifier
from trade._notifications.services import Hosted, placed
from trade._notifications.triggers import OF_CHANGES, TriggerSpec, What, action_of, epoch_s, target_of
from trade._registry.constraints import Constraint, as_constraint, services_at, where
from trade.errors import NoSuchNotification
from trade.protocol.keys import DOMAIN

POLL_S: Final = 1.0


class NotificationApi:
    """The notifications of this container, here and in others."""

    def __init__(self, client: CallClient, notifier: Notifier) -> None:
        self._client = client
        self._notifier = notifier

    # --- of services

    def joined(
        self, which: Constraint | str, call: What, *, existing: bool = False, if_: What | None = None, host: str = ""
    ) -> Notification:
        """Makes a call, with its handle, for every matching service that appears, one after the other.

        Args:
            which: the services, by a constraint or as text.
            call: a handle, a bound call (the handle comes before its own arguments), one service by a constraint or as
                text, or a function of this process.
            existing: also once for each present service.
            if_: only if this returns True then; called without arguments.
            host: the container that keeps it; by default this one. It also ends with this one, unless it is detached.

        Raises:
            ConfigurationError: the call is not callable, is a function for another container, or too many exist there.
            AccessDenied: with ``host=``, by the policy.
        """
        services = as_constraint(which, "trade.joined", services_at)
        terms = TriggerSpec(occasion="joined", constraint=services, existing=existing)
        return self._notify(terms, call, if_, None, host)

    def left(self, which: Constraint | str, call: What, *, if_: What | None = None, host: str = "") -> Notification:
        """Makes a call, with its (stale) handle, for every matching service that disappears; else like `joined`."""
        services = as_constraint(which, "trade.left", services_at)
        return self._notify(TriggerSpec(occasion="left", constraint=services), call, if_, None, host)

    def changed(self, which: Constraint | str, call: What, *, if_: What | None = None, host: str = "") -> Notification:
        """Makes a call for every service whose groups, metadata, health or description change, with its handle.

        It fires for services that match, and once more when they no longer do. One call may report several quick
        changes. The rest is as for `joined`.
        """
        services = as_constraint(which, "trade.changed", services_at)
        return self._notify(TriggerSpec(occasion="changed", constraint=services), call, if_, None, host)

    def occurred(
        self,
        events: EventKind | Sequence[EventKind],
        call: What,
        *,
        about: Constraint | str | None = None,
        if_: What | None = None,
        host: str = "",
    ) -> Notification:
        """Makes a call, with the `StateEvent`, at each event of these kinds in one container; else like `joined`.

        Args:
            events: one kind or several, such as ``"unlinked"``, ``"hook_suspended"`` or ``"call_deviated"``.
            call: as for `joined`; it takes a `StateEvent`.
            about: only events about these services. An event about a container is about its service ``clock``: so
                ``where(container="base")`` selects those about container base.
            if_: as for `joined`.
            host: the container whose events these are, and which keeps it; by default this one.
        """
        kinds = (events,) if isinstance(events, str) else tuple(events)
        services = None if about is None else as_constraint(about, "trade.occurred", services_at)
        return self._notify(TriggerSpec(occasion="occurred", events=kinds, constraint=services), call, if_, None, host)

    # --- of time

    def once(
        self,
        call: What,
        *,
        if_: What | None = None,
        when: What | None = None,
        poll_s: float = POLL_S,
        host: str = "",
    ) -> Notification:
        """Makes a call once, without waiting for it.

        Args:
            call: a handle, a bound call, a constraint that one service matches, or a function of this process.
            if_: make it only if this returns True at that moment.
            when: wait until this returns True; it is called now and every ``poll_s`` seconds.
            poll_s: the interval, in seconds.
            host: the container that keeps it; by default this one. It also ends with this one, unless it is detached.

        Raises:
            ConfigurationError: the call is not callable, is a function for another container, or the time is not valid.
            AccessDenied: with ``host=``, by the policy.
        """
        return self._notify(TriggerSpec(occasion="once", poll_s=poll_s), call, if_, when, host)

    def after(
        self,
        s: float,
        call: What,
        *,
        if_: What | None = None,
        when: What | None = None,
        poll_s: float = POLL_S,
        host: str = "",
    ) -> Notification:
        """Makes a call after ``s`` seconds, counted from the time when ``when`` holds; else like `once`."""
        return self._notify(TriggerSpec(occasion="after", s=s, poll_s=poll_s), call, if_, when, host)

    def at(
        self,
        moment: datetime,
        call: What,
        *,
        if_: What | None = None,
        when: What | None = None,
        poll_s: float = POLL_S,
        host: str = "",
    ) -> Notification:
        """Makes a call at a time of day, by the wall clock of the container that keeps it, even if that is adjusted.

        If ``when`` holds only later, the call is made then. The rest is as for `once`.

        Args:
            moment: with a time zone; not in the past.
            call: as for `once`.
            if_: as for `once`.
            when: as for `once`.
            poll_s: as for `once`.
            host: as for `once`.
        """
        at_s = epoch_s(moment, time.time())
        return self._notify(TriggerSpec(occasion="at", at=at_s, poll_s=poll_s), call, if_, when, host)

    def every(
        self,
        s: float,
        call: What,
        *,
        if_: What | None = None,
        when: What | None = None,
        edge: bool = False,
        poll_s: float = POLL_S,
        host: str = "",
    ) -> Notification:
        """Makes a call every ``s`` seconds, the first one after ``s`` seconds; else like `once`.

        A call that takes longer delays the next: the ticks that pass meanwhile become one.

        Args:
            s: the interval in seconds, from 0.001.
            call: as for `once`.
            if_: skip ticks at which this does not return True.
            edge: also skip ticks if it returned True at the tick before.
            when: begin when this returns True.
            poll_s: as for `once`.
            host: as for `once`.
        """
        return self._notify(TriggerSpec(occasion="every", s=s, edge=edge, poll_s=poll_s), call, if_, when, host)

    # --- seeing and ending

    def notifications(self) -> list[NotificationInfo]:
        """All notifications in the system."""
        found = [info for infos in self._client.ask_all("notifications") for info in infos]
        return sorted(found, key=lambda info: (info.container, info.id))

    def cancel_notification(self, notification: str) -> None:
        """Ends a notification by its id, in any container, also one of another client.

        Raises:
            NoSuchNotification: none has that id, or it has ended.
            AccessDenied: it is another client's, and the policy does not let this container administer the system.
        """
        if not any(self._client.ask_all("cancel_notification", notification)):
            raise NoSuchNotification(id=notification)

    def _notify(self, terms: TriggerSpec, call: What, if_: What | None, when: What | None, host: str) -> Notification:
        terms.check()
        named = f"trade.{terms.occasion}"
        target = target_of(call, named, "call", 1 if terms.occasion in OF_CHANGES else 0)
        conditions = [None if what is None else target_of(what, named, "a condition", 0) for what in (if_, when)]
        own = self._client.address
        if not host or host == own.container:
            client = speaking.get()
            mine = client if client is not None and client.owner == own else None
            owner = Owner(str(own) if mine is None else mine.name, acts_as=mine)
            return placed(self._notifier, self._client.registry, terms, target, conditions[0], conditions[1], owner)
        notify = self._client.find(where(name="notify", group=DOMAIN, container=host))
        actions = [None if one is None else action_of(one, host, named) for one in conditions]
        name = notify(terms, action_of(target, host, named), *actions)
        return Hosted(name, terms, notify.key.address, self._client.handle)
