"""What every container offers about making, moving and ending providers, in group ``trade``."""

from typing import Any, Protocol

from trade._calls.handle import Handle
from trade._context.call_context import current_call, served_call
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget, Prepared, ProviderSnapshot
from trade._protocol.container_info import ContainerInfo
from trade._services.decorator import service


class Maker(Protocol):
    """What makes objects and containers, and ends them."""

    def instantiate(
        self, class_path: str, args: tuple[Any, ...] | dict[str, Any], groups: tuple[str, ...], state: Any
    ) -> tuple[Handle, ...]: ...

    def start_container(self, host: str, name: str, *, allow: tuple[str, ...]) -> ContainerInfo: ...

    def terminate(self, service: Handle) -> None: ...

    def terminate_container(self, reason: str, *, only_at_rest: bool, who: str) -> list[str]: ...


class FactoryServices:
    """The wire's side of `Making`, and of the end of a container."""

    def __init__(self, system: Maker) -> None:
        self._of_here = system

    @service
    def instantiate(
        self,
        class_path: str,
        args: tuple[Any, ...] | dict[str, Any] = (),
        groups: tuple[str, ...] = (),
        state: Any = None,
    ) -> tuple[Handle, ...]:
        """Make an object of a class that this container allows, give it its state if there is some, and offer it."""
        return self._of_here.instantiate(class_path, args, groups, state)

    @service
    def start_container(self, host: str, name: str, allow: tuple[str, ...] = ()) -> ContainerInfo:
        """Start an empty container on another host through the ssh program of this one, with its user's keys."""
        return self._of_here.start_container(host, name, allow=allow)

    @service
    def terminate(self, service: Handle) -> None:
        """End a provider that instantiate made here: what it moves stops, then it is closed."""
        self._of_here.terminate(service)

    @service
    def terminate_container(self, reason: str = "", only_at_rest: bool = False) -> list[str]:
        """End this container: what moves stops, its services are withdrawn; what could not be stopped, and why."""
        call = current_call()
        who = "itself" if call is None else call.caller
        return self._of_here.terminate_container(reason, only_at_rest=only_at_rest, who=who)


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
