"""Asking for notifications: on this occasion, if this holds, make that call."""

import time
from datetime import datetime
from typing import Final

from trade._container.lookup import Lookup
from trade._context.sessions import speaking
from trade._notifications.notification import Notification, NotificationInfo, Owner
from trade._notifications.notifier import Notifier
from trade._notifications.services import Hosted, placed
from trade._notifications.triggers import OF_SERVICES, TriggerSpec, What, deed_of, epoch_s, target_of
from trade._protocol.keys import DOMAIN
from trade._registry.constraints import Constraint, where
from trade._registry.registry import Registry
from trade.errors import NoSuchNotification

POLL_S: Final = 1.0


class Notifying:
    """Standing requests of this container, and those that others keep for it."""

    def __init__(self, lookup: Lookup, notifier: Notifier, registry: Registry) -> None:
        self._lookup = lookup
        self._notifier = notifier
        self._registry = registry

    # --- of services

    def joined(
        self, constraint: Constraint, call: What, *, existing: bool = False, if_: What | None = None, host: str = ""
    ) -> Notification:
        """Call with the handle of every service that comes and matches, one after the other.

        Args:
            constraint: which services.
            call: a handle, a bound call (the handle comes before its own arguments), a constraint that one service
                fits, or a function of this process.
            existing: also once for each that is there already.
            if_: only if this answers True then; asked without arguments.
            host: the container it is to live in; by default this one. It ends with this one all the same, unless
                it is detached.

        Raises:
            ConfigurationError: what cannot be called, a function for another container, too many there.
            AccessDenied: with ``host=``, by the policy.
        """
        terms = TriggerSpec(occasion="joined", constraint=constraint, existing=existing)
        return self._notify(terms, call, if_, None, host)

    def left(self, constraint: Constraint, call: What, *, if_: What | None = None, host: str = "") -> Notification:
        """Call with the (dead) handle of every service that goes and matched; the rest as for `joined`."""
        return self._notify(TriggerSpec(occasion="left", constraint=constraint), call, if_, None, host)

    def changed(self, constraint: Constraint, call: What, *, if_: What | None = None, host: str = "") -> Notification:
        """Call with the handle of every service whose groups, metadata, health or description become others.

        It fires for what matches, and once more for what has just ceased to. Who is quick may find several changes in
        one. The rest is as for `joined`.
        """
        return self._notify(TriggerSpec(occasion="changed", constraint=constraint), call, if_, None, host)

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
        """Make that call once, without waiting for it.

        Args:
            call: a handle, a bound call, a constraint that one service fits, or a function of this process.
            if_: make it only if this answers True at that moment.
            when: wait for this to answer True; it is asked now and every ``poll_s`` seconds.
            poll_s: how often, in seconds.
            host: the container it is to live in; by default this one. It ends with this one all the same, unless
                it is detached.

        Raises:
            ConfigurationError: what cannot be called, a function for another container, no such time.
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
        """Make that call after so many seconds, counted from when ``when`` holds; the rest as for `once`."""
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
        """Make that call at a moment, by the clock on the wall of the container it lives in, also if that is set.

        If ``when`` holds later only, it is made then. The rest is as for `once`.

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
        """Make that call every so many seconds, for the first time after so many; the rest as for `once`.

        A call that takes longer than that holds up the next: ticks that pass meanwhile become one.

        Args:
            s: the interval in seconds, from 0.001.
            call: as for `once`.
            if_: skip ticks at which this does not answer True.
            edge: skip those, too, at which it did so already at the tick before.
            when: begin when this answers True.
            poll_s: as for `once`.
            host: as for `once`.
        """
        return self._notify(TriggerSpec(occasion="every", s=s, edge=edge, poll_s=poll_s), call, if_, when, host)

    # --- seeing and ending

    def notifications(self) -> list[NotificationInfo]:
        """Every notification that stands anywhere in the system."""
        found = [info for infos in self._lookup.ask_all("notifications") for info in infos]
        return sorted(found, key=lambda info: (info.container, info.id))

    def cancel_notification(self, notification: str) -> None:
        """End a notification, wherever it lives and whoever asked for it.

        Raises:
            NoSuchNotification: none has that id, or it has ended.
            AccessDenied: it is another's, and the policy does not let this container administer the system.
        """
        if not any(self._lookup.ask_all("cancel_notification", notification)):
            raise NoSuchNotification(id=notification)

    def _notify(self, terms: TriggerSpec, call: What, if_: What | None, when: What | None, host: str) -> Notification:
        terms.check()
        named = f"trade.{terms.occasion}"
        target = target_of(call, named, "call", 1 if terms.occasion in OF_SERVICES else 0)
        conditions = [None if what is None else target_of(what, named, "a condition", 0) for what in (if_, when)]
        own = self._lookup.home.address
        if not host or host == own.container:
            client = speaking.get()
            mine = client if client is not None and client.owner == own else None
            owner = Owner(str(own) if mine is None else mine.name, acts_as=mine)
            return placed(self._notifier, self._registry, terms, target, conditions[0], conditions[1], owner)
        notify = self._lookup.find(where(name="notify", group=DOMAIN, container=host))
        deeds = [None if one is None else deed_of(one, host, named) for one in conditions]
        name = notify(terms, deed_of(target, host, named), *deeds)
        return Hosted(name, terms, notify.key.address, self._lookup.handle)
