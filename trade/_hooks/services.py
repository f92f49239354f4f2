"""The services for hooks that every container offers, in group ``trade``."""

import contextlib
import logging

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import served_call
from trade._hooks.callee import Callee
from trade._hooks.hook import AttachedHook, HookInfo, Hooks, Side
from trade._registry.constraints import Constraint
from trade._services.decorator import service
from trade.errors import CallerError, CallError, ConfigurationError
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey

_logger = logging.getLogger("trade")


class HookServices:
    """Attaches, lists and detaches hooks in this container for all clients."""

    def __init__(self, hooks: Hooks, client: CallClient) -> None:
        self._hooks = hooks
        self._client = client
        hooks.suspended.subscribe(self._notify_hook_owner)

    @service
    def attach_hook(
        self,
        name: str,
        side: Side,
        call: Handle | None = None,
        handle: Handle | None = None,
        constraint: Constraint | None = None,
        call_where: Constraint | None = None,
        limit_s: float = 0.0,
    ) -> list[str]:
        """Call a service before or after services of this container, now and later; returns the current ones."""
        asked, target, which = served_call(), constraint if handle is None else handle, call or call_where
        if target is None or which is None:
            raise ConfigurationError(
                where="attach_hook", problem="it needs a handle or a constraint, of each of the two"
            )
        if call is not None:
            self._client.registry.wait_until_known([call.key])  # calls under way do not wait for it
        return self._hooks.attach(name, side, target, Callee(which), asked.session, asked.caller, limit_s or None)

    @service
    def detach_hook(self, name: str) -> bool:
        """Detach the hooks of a name in this container; returns whether any existed. Others' require ``administer``."""
        asked, found = served_call(), self._hooks.named(name)
        for hook in found:
            if hook.identity != asked.caller:
                self._client.access.require(asked.caller, "administer", DOMAIN, f"hook {name}")
            self._hooks.detach(hook.owner, name)
        return bool(found)

    @service(effect="read")
    def hooks(self) -> list[HookInfo]:
        """The hooks on services of this container, of all owners."""
        return self._hooks.infos()

    @service
    def hook_suspended(self, name: str, call: str, error: str) -> None:
        """For containers: a hook that was attached from this container failed too often."""
        _logger.warning(
            "hook %s (%s), attached from here, is suspended by %s: %s", name, call, served_call().session, error
        )

    def _notify_hook_owner(self, hook: AttachedHook) -> None:
        owner = Address(*hook.owner.split("/")[:3])
        with contextlib.suppress(CallerError, CallError):  # the owner has gone
            suspended = self._client.handle(ServiceKey(owner, DOMAIN, PROVIDER, "hook_suspended"))
            suspended.start(hook.name, hook.call.text, hook.last_error)
