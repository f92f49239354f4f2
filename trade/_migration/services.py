"""The services for moving providers that every container offers, in group ``trade``."""

from typing import Any

from trade._calls.handle import Handle
from trade._context.call_context import served_call
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget, Prepared, ProviderSnapshot
from trade._services.decorator import service


class MigrationServices:
    """Moves providers to and from this container, and saves and restores their state."""

    def __init__(self, source: MigrationSource, target: MigrationTarget) -> None:
        self._source = source
        self._target = target

    @service
    def migrate(self, service: Handle, to: str, args: tuple[Any, ...] | dict[str, Any] | None = None) -> list[Handle]:
        """Move a provider of this container to another one, with its state; returns handles of its services there."""
        return self._source.migrate(service, to, args, served_call().caller)

    @service
    def save_state(self, service: Handle) -> Any:
        """The state of a provider of this container, taken while it neither runs nor moves."""
        return self._source.save_state(service, served_call().caller)

    @service
    def restore_state(self, service: Handle, state: Any) -> None:
        """Give a provider of this container its state while it neither runs nor moves."""
        self._source.restore_state(service, state, served_call().caller)

    @service
    def prepare_arrival(self, snapshot: ProviderSnapshot) -> Prepared:
        """For containers: create the arriving provider with its state; it is closed if it is not fetched in time."""
        return self._target.prepare(snapshot, served_call().caller)

    @service
    def arrive(self, ticket: str) -> None:
        """For containers: offer the prepared provider."""
        self._target.arrive(ticket, served_call().caller)

    @service
    def arrived(self, ticket: str) -> bool:
        """For containers: whether the prepared provider is offered; if it is not, it never will be."""
        return self._target.arrived(ticket, served_call().caller)
