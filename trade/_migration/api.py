"""Migration of providers, and saving and restoring their state."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._registry.constraints import Constraint, as_constraint, services_at
from trade.errors import NoSuchService, TooManyServices
from trade.protocol.keys import DOMAIN, PROVIDER, ServiceKey

_LONGEST_S: Final = 45.0


class MigrationApi:
    """Requests migrations and states from the containers of the providers."""

    def __init__(self, client: CallClient) -> None:
        self._client = client

    def migrate(
        self, which: Handle | Constraint | str, *, to: str, args: Sequence[Any] | Mapping[str, Any] | None = None
    ) -> tuple[Handle, ...]:
        """Moves a provider with its state to another container, on this host or another one.

        No client can call it meanwhile, and it is never offered twice. The state from ``save_state()`` goes to another
        object of the class with ``restore_state(state)``; classes without these methods start without state. Its groups
        and metadata move with it, and the old object is closed (``close()``, if it has that). Handles do not follow:
        they raise ServiceGone, which names the new place; constraints find it.

        Args:
            which: a service of the provider, or a constraint or a group as text that only its services match.
            to: name of the container; with ``*`` or ``?`` the least busy one that fits. It must allow the class.
            args: for the constructor there; by default those that it was instantiated with, if any.

        Returns:
            Handles of its services there.

        Raises:
            LockedByOther: another client has locked it, it moves, or a call of it does not end.
            Stopped: a stop holds, and has not been resumed.
            NoSuchService, TooManyServices: not one provider, or no such container.
            NotInstantiable, NoSuchClass, CannotInstantiate: it cannot be created there.
            CannotMigrate: the class is another version there, its state was not saved or restored, or it took too long.
            ConfigurationError: it drives hardware of its host, or shares something with other providers.
            AccessDenied: the policy does not let this container administer its groups, or the other one offer it.
            Busy: the other container has no room at the moment.
            MigrationUnknown: the other container was lost during the move; it is withdrawn here. After all other errors
                it is offered as before.
        """
        moved: tuple[Handle, ...] = tuple(self._of(which, "migrate", to, args))
        self._client.registry.wait_until_known(one.key for one in moved)
        return moved

    def save_state(self, which: Handle | Constraint | str) -> Any:
        """The state that a provider returns from ``save_state()``, while it neither runs nor moves: plain data.

        Raises:
            ConfigurationError: its class has no such method.
            LockedByOther, Stopped, NoSuchService, TooManyServices, AccessDenied: as for `migrate`.
        """
        return self._of(which, "save_state")

    def restore_state(self, which: Handle | Constraint | str, state: Any) -> None:
        """Gives a provider an earlier state back. Motion that it commands meanwhile is refused (S18).

        Raises:
            ConfigurationError, LockedByOther, Stopped, NoSuchService, TooManyServices, AccessDenied: as for
                `save_state`.
        """
        self._of(which, "restore_state", state)

    def _of(self, which: Handle | Constraint | str, name: str, *args: Any) -> Any:
        service = which if isinstance(which, Handle) else self._one(as_constraint(which, f"trade.{name}", services_at))
        key = ServiceKey(service.key.address, DOMAIN, PROVIDER, name)
        return self._client.handle(key).with_(deadline_s=_LONGEST_S)(service, *args)

    def _one(self, which: Constraint) -> Handle:
        found = {(one.key.address, one.key.domain, one.key.provider): one for one in self._client.services(which)}
        if not found:
            raise NoSuchService(constraint=str(which))
        if len(found) > 1:
            raise TooManyServices(constraint=str(which), matches=[one.label for one in found.values()])
        return next(iter(found.values()))
