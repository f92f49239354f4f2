"""What every container offers about moving providers and their state, in group ``trade``."""

from typing import Any

from trade._calls.handle import Handle
from trade._context.call_context import served_call
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget, Prepared, ProviderSnapshot
from trade._services.decorator import service


class MigrationServices:
    """The wire's side of `MigrationSource` and `MigrationTarget`."""

    def __init__(self, departing: MigrationSource, arriving: MigrationTarget) -> None:
        self._departing = departing
        self._arriving = arriving

    @service
    def migrate(self, service: Handle, to: str, args: tuple[Any, ...] | dict[str, Any] | None = None) -> list[Handle]:
        """Have a provider of this container go on in another one, with its state; handles of its services there."""
        return self._departing.migrate(service, to, args, served_call().caller)

    @service
    def save_state(self, service: Handle) -> Any:
        """The state of a provider of this container, while nothing of it runs or moves."""
        return self._departing.save_state(service, served_call().caller)

    @service
    def restore_state(self, service: Handle, state: Any) -> None:
        """Give a provider of this container its state, while nothing of it runs or moves."""
        self._departing.restore_state(service, state, served_call().caller)

    @service
    def prepare_arrival(self, luggage: ProviderSnapshot) -> Prepared:
        """For containers: make what is to come and give it its state; it is closed again if nobody fetches it."""
        return self._arriving.prepare(luggage, served_call().caller)

    @service
    def arrive(self, ticket: str) -> None:
        """For containers: offer what was prepared."""
        self._arriving.arrive(ticket, served_call().caller)

    @service
    def arrived(self, ticket: str) -> bool:
        """For containers: whether what was prepared is offered; if it is not, it never will be."""
        return self._arriving.arrived(ticket, served_call().caller)
