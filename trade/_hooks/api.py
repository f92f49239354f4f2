"""The hook methods of a container: a hook calls a service before or after another one, in any container."""

import contextlib
import itertools
import logging
from typing import Any, Final

from trade._calls.client import CallClient
from trade._calls.handle import BoundCall, Handle
from trade._calls.run import Run
from trade._hooks.callee import Callee, callee_of
from trade._hooks.hook import HookInfo, Side, require_limit
from trade._notifications.api import NotificationApi
from trade._notifications.notification import Notification
from trade._registry.constraints import Constraint, as_constraint, services_at, where
from trade.errors import AccessDenied, ConfigurationError, ContainerLost, NoSuchHook, ServiceGone, TradeError
from trade.protocol.keys import DOMAIN, PROVIDER, ServiceKey

_logger = logging.getLogger("trade")

_EVERYWHERE: Final = where(name="attach_hook", group=DOMAIN)


class Hook:
    """A hook that this container has attached; it ends when it is detached or this container ends."""

    def __init__(
        self,
        api: "HookApi",
        name: str,
        side: Side,
        target: Handle | Constraint,
        call: Callee,
        limit_s: float | None,
    ) -> None:
        self.id: Final = name
        """Its id, unique in the system."""
        self.target_text: Final = f"hook {name}"
        self.side: Final[Side] = side
        self.target: Final = target
        self.call: Final = call.handle or call.constraint
        self._callee: Final = call
        self._limit_s: Final = limit_s
        self._api = api
        self._later: Notification | None = None
        self._attached = True

    def begin(self) -> None:
        """Attaches it in all present and future containers. Raises the first error of the present ones."""
        if isinstance(self.target, Handle):
            self._attach(
                self._api.client.handle(ServiceKey(self.target.key.address, DOMAIN, PROVIDER, "attach_hook"))
            ).result()
            return
        present = self._api.client.everywhere("attach_hook")
        for address in present.silent:
            _logger.warning("hook %s is not attached in %s yet: it has not listed its services", self.id, address.who)
        runs = [self._attach(handle) for handle in present.handles]
        errors = [error for error in (run.exception() for run in runs) if error is not None]
        refusal = next((error for error in errors if isinstance(error, AccessDenied | ConfigurationError)), None)
        if refusal is not None:
            self.detach()
            raise refusal
        # Present containers are reported, too: a second attachment of the same hook has no effect.
        self._later = self._api.notifications.joined(_EVERYWHERE, self._join, existing=True)

    def _attach(self, handle: Handle) -> Run:
        terms: dict[str, Any] = {"handle" if isinstance(self.target, Handle) else "constraint": self.target}
        if self._callee.constraint is not None:
            terms["call_where"] = self._callee.constraint
        if self._limit_s is not None:
            terms["limit_s"] = self._limit_s
        return handle.start(self.id, self.side, self._callee.handle, **terms)

    def _join(self, handle: Handle) -> None:
        if not self._attached:
            return
        try:
            self._attach(handle).result()
            if not self._attached:  # detached meanwhile, perhaps before this arrived
                self._api.client.handle(ServiceKey(handle.key.address, DOMAIN, PROVIDER, "detach_hook"))(self.id)
        except (ContainerLost, ServiceGone):  # it has left already
            _logger.debug("hook %s is not attached in %s, which has ended", self._callee.text, handle.container)
        except TradeError as error:
            _logger.warning("hook %s is not attached in %s: %s", self._callee.text, handle.container, error)

    def infos(self) -> list[HookInfo]:
        """Its state in each container."""
        return [info for info in self._api.hooks() if info.id == self.id]

    def detach(self) -> None:
        """Detaches it; a call of it under way finishes. Idempotent."""
        if self._attached:
            self._attached = False
            if self._later is not None:
                self._later.cancel()
            with contextlib.suppress(NoSuchHook):  # its containers are gone
                self._api.detach_hook(self.id)

    def __repr__(self) -> str:
        return f"<Hook {self._callee.text} {self.side} {self.target}{'' if self._attached else ', detached'}>"


class HookApi:
    """The hooks of this container on services of any container."""

    def __init__(self, client: CallClient, notifications: NotificationApi) -> None:
        self.client: Final = client
        self.notifications: Final = notifications
        self._numbers = itertools.count(1)

    def before_service(
        self, target: Handle | Constraint | str, call: Handle | Constraint | str, *, limit_s: float | None = None
    ) -> Hook:
        """Calls a service before each call of another one, with a copy of its arguments.

        It runs in that service's container and delays its call by 0.1 s at most, together with other hooks by 0.25 s.
        It never changes the call. After three failures in a row it is suspended. With a handle, that is for good. With
        a constraint, it continues once another service joins that matches, such as the observer after its restart.

        Args:
            target: a service, or all that match a constraint or a text, later ones included. A stop has no hooks
                before it.
            call: takes one argument, a `HookEvent`: a service, or the only one that matches a constraint or a text at
                the time of the call. Calls are not observed while none matches.
            limit_s: how long it may take, in seconds, at most 60; None: as the service's container says
                (``TRADE_HOOK_LIMIT_S``). All hooks of one side of a call together have two and a half times the longest
                limit among them.

        Raises:
            AccessDenied: the policy does not let this container ``instrument`` the service, or any present one.
            ConfigurationError: the target is a stop, the limit is out of range, or an argument names no service.
        """
        return self._hook("before", target, call, limit_s)

    def after_service(
        self, target: Handle | Constraint | str, call: Handle | Constraint | str, *, limit_s: float | None = None
    ) -> Hook:
        """Calls a service after each call of another one, with its outcome, before the caller gets the answer.

        After a stop it runs when the caller has the answer. The rest is as for `before_service`.
        """
        return self._hook("after", target, call, limit_s)

    def _hook(
        self,
        side: Side,
        given: Handle | Constraint | str,
        call: Handle | Constraint | str,
        limit_s: float | None,
    ) -> Hook:
        named = f"trade.{side}_service"
        target = given if isinstance(given, Handle) else as_constraint(given, named, services_at)
        if not isinstance(call, Handle | Constraint | str):  # pyright: ignore[reportUnnecessaryIsInstance]
            rest = (
                "without arguments of its own" if isinstance(call, BoundCall) else "as it runs where the service does"
            )
            problem = f"call must be a handle, where(...) or a text such as 'eye.see', {rest}, not {call!r}"
            raise ConfigurationError(where=named, problem=problem)
        callee = callee_of(call, named)
        require_limit(limit_s, named)
        self._require_instrument(target)
        hook = Hook(self, f"{self.client.address.epoch}.h{next(self._numbers)}", side, target, callee, limit_s)
        hook.begin()
        return hook

    def _require_instrument(self, target: Handle | Constraint) -> None:
        """Raises AccessDenied if, by the policy here, all of these would refuse it."""
        known = [target] if isinstance(target, Handle) else self.client.services(target)
        mine = [one for one in known if one.key.domain != DOMAIN]
        who = self.client.address.identity
        denials = [self.client.access.denied(who, "instrument", one.key.domain, one.label) for one in mine]
        denied = next((one for one in denials if one is not None), None)
        if denied is not None and all(denials):
            raise denied

    def hooks(self) -> list[HookInfo]:
        """All hooks in the system, one entry for each container where a hook is attached."""
        found = [info for infos in self.client.ask_all("hooks") for info in infos]
        return sorted(found, key=lambda info: (info.container, info.id))

    def detach_hook(self, hook: str) -> None:
        """Detaches a hook by its id, in all containers, also one of another client.

        Raises:
            NoSuchHook: no hook has that id.
            AccessDenied: it is another client's, and the policy does not let this container administer the system.
        """
        if not any(self.client.ask_all("detach_hook", hook)):
            raise NoSuchHook(id=hook)
