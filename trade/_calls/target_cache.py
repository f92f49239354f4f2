"""The cache of call targets: a handle's target is kept until its service or the policy changes."""

from typing import Final

from trade._audit.events import Audit
from trade._calls.caller import Caller
from trade._calls.handle import Handle
from trade._calls.target import LocalTarget, RemoteTarget, container_closed
from trade._registry.registry import Change, Record, Registry, gone_to
from trade._security.authorizer import Authorizer
from trade._services.providers import Providers
from trade._threads.thread_pool import ThreadPool
from trade.errors import AccessDenied, ServiceGone, as_never_ran
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, ServiceKey
from trade.protocol.messages import ServiceInfo
from trade.transport.base import ChannelClosed

Target = LocalTarget | RemoteTarget

"""How long a call waits for the registry entry of a handle that arrived in a message before it."""


class Targets:
    """The call targets of a container, by service."""

    def __init__(
        self,
        access: Authorizer,
        registry: Registry,
        providers: Providers,
        caller: Caller,
        codec: Codec,
        audit: Audit,
    ) -> None:
        self._audit = audit
        self._own = caller.own
        self._access = access
        self._registry = registry
        self._providers = providers
        self._caller = caller
        self._codec = codec
        self._thread_pool = ThreadPool()
        self._closed = False
        self.known: Final[dict[ServiceKey, Target]] = {}
        """Targets that were looked up, and are allowed."""

    def look_up(self, handle: Handle) -> Target:
        """Looks up the target of a handle, and keeps it.

        Raises:
            ServiceGone: the service does not exist, or no longer.
            AccessDenied: the policy does not let this container call it.
            ConfigurationError: the container is closed.
        """
        key, policy = handle.key, self._access.policy
        if handle.last_record is None:
            self._registry.wait_until_known([key])
        record = self._registry.get(key)
        if record is not None:
            self._require(record)
        target = None if record is None else self._make(record)
        if target is None:
            raise self.gone_error(handle)
        self.known[key] = target
        changed = self._registry.get(key) is not record or self._access.policy is not policy
        if self._closed or changed:  # it was removed or replaced meanwhile
            self.known.pop(key, None)
        return target

    def _require(self, record: Record) -> None:
        key, identity = record.key, self._own.identity
        try:
            self._access.require_call(identity, key.domain, key.name, record.info.effect, record.label)
        except AccessDenied as denied:
            self._audit.refused(record.label, denied, who=identity, session=self._caller.session)
            raise

    def _make(self, record: Record) -> Target | None:
        if not record.local:
            try:
                return RemoteTarget(record, self._caller, self._codec, self._own_description(record))
            except ChannelClosed:  # closed meanwhile
                raise container_closed(self._own) from None
        service = self._providers.lookup(f"{record.key.domain}/{record.key.provider}", record.key.name)
        if service is None:  # deregistered meanwhile
            return None
        return LocalTarget(service, record, self._codec, self._caller, self._thread_pool)

    def _own_description(self, record: Record) -> ServiceInfo | None:
        """This container's own description of a middleware function that another container has, too.

        It takes precedence over the other container's description, which may come from another language.
        """
        key = record.key
        if key.domain != DOMAIN or key.provider not in (PROVIDER, ESTOP_PROVIDER):
            return None
        service = self._providers.services_at(f"{DOMAIN}/{key.provider}").get(key.name)
        return None if service is None else service.info

    def gone_error(self, handle: Handle) -> ServiceGone:
        """The error of a handle without a target."""
        return as_never_ran(self._gone(handle), handle.key)

    def _gone(self, handle: Handle) -> ServiceGone:
        address = handle.key.address
        if moved_to := self._registry.moved_to(handle.key):
            return gone_to(handle.label, moved_to)
        if self._registry.is_alive(address):
            reason = "its provider was deregistered" if self._registry.removed(handle.key) else "it is not known here"
        else:
            reason = f"container {address.container} has ended, restarted or cannot be reached"
        return ServiceGone(service=handle.label, reason=reason)

    def changed(self, change: Change) -> None:
        """Forgets the targets of removed services, so that their calls fail at once; called by the registry."""
        for record in (*change.left, *change.replaced):
            self.known.pop(record.key, None)
        for record in change.left:
            key = record.key
            if not record.local and (self._registry.removed(key) or not self._registry.is_alive(key.address)):
                self._caller.publishers.forget(key.address, key.domain, key.provider)

    def recheck_access(self) -> None:
        """Forgets all targets, because the policy has changed."""
        self.known.clear()

    def close(self) -> None:
        """Keeps no more targets."""
        self._closed = True
        self._thread_pool.close()
        self.known.clear()
