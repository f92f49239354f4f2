"""The services for creating, moving and ending providers that every container offers, in group ``trade``."""

from typing import Any, Protocol

from trade._calls.handle import Handle
from trade._context.call_context import current_call, served_call
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget, Prepared, ProviderSnapshot
from trade._protocol.container_info import ContainerInfo
from trade._services.decorator import service


class Maker(Protocol):
    """Creates objects and containers, and ends them."""

    def instantiate(
        self, class_path: str, args: tuple[Any, ...] | dict[str, Any], groups: tuple[str, ...], state: Any
    ) -> tuple[Handle, ...]: ...

    def start_container(
        self,
        host: str,
        name: str,
        *,
        allow: tuple[str, ...],
        connect: tuple[str, ...],
        command: tuple[str, ...],
        environment: dict[str, str],
    ) -> ContainerInfo: ...

    def add_code(self, archive: bytes) -> str: ...

    def terminate(self, service: Handle) -> None: ...

    def terminate_container(self, reason: str, *, only_at_rest: bool, who: str) -> list[str]: ...


class FactoryServices:
    """The wire side of `Making`, and of the end of a container."""

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
        """Create an object of a class that this container allows, give it its state if there is one, and offer it."""
        return self._of_here.instantiate(class_path, args, groups, state)

    @service
    def start_container(
        self,
        host: str,
        name: str,
        allow: tuple[str, ...] = (),
        connect: tuple[str, ...] = (),
        command: tuple[str, ...] = ("trade",),
        environment: dict[str, str] = {},  # noqa: B006 - never changed
    ) -> ContainerInfo:
        """Start an empty container on another host through the ssh program of this one, with its user's keys."""
        return self._of_here.start_container(
            host, name, allow=allow, connect=connect, command=command, environment=environment
        )

    @service
    def add_code(self, archive: bytes) -> str:
        """Keep an archive of modules whose hash this container allows, and import from it; returns the hash."""
        return self._of_here.add_code(archive)

    @service
    def terminate(self, service: Handle) -> None:
        """End a provider that instantiate made here: what it moves stops, then it is closed."""
        self._of_here.terminate(service)

    @service
    def terminate_container(self, reason: str = "", only_at_rest: bool = False) -> list[str]:
        """End this container: stop what moves and withdraw its services; returns what could not be stopped, and why."""
        call = current_call()
        who = "itself" if call is None else call.caller
        return self._of_here.terminate_container(reason, only_at_rest=only_at_rest, who=who)


class MigrationServices:
    """The wire side of `MigrationSource` and `MigrationTarget`."""

    def __init__(self, departing: MigrationSource, arriving: MigrationTarget) -> None:
        self._departing = departing
        self._arriving = arriving

    @service
    def migrate(self, service: Handle, to: str, args: tuple[Any, ...] | dict[str, Any] | None = None) -> list[Handle]:
        """Move a provider of this container to another one, with its state; returns handles of its services there."""
        return self._departing.migrate(service, to, args, served_call().caller)

    @service
    def save_state(self, service: Handle) -> Any:
        """The state of a provider of this container, taken while it neither runs nor moves."""
        return self._departing.save_state(service, served_call().caller)

    @service
    def restore_state(self, service: Handle, state: Any) -> None:
        """Give a provider of this container its state while it neither runs nor moves."""
        self._departing.restore_state(service, state, served_call().caller)

    @service
    def prepare_arrival(self, snapshot: ProviderSnapshot) -> Prepared:
        """For containers: create the arriving provider with its state; it is closed if it is not fetched in time."""
        return self._arriving.prepare(snapshot, served_call().caller)

    @service
    def arrive(self, ticket: str) -> None:
        """For containers: offer the prepared provider."""
        self._arriving.arrive(ticket, served_call().caller)

    @service
    def arrived(self, ticket: str) -> bool:
        """For containers: whether the prepared provider is offered; if it is not, it never will be."""
        return self._arriving.arrived(ticket, served_call().caller)
