"""The services of every container about itself, in group ``trade``: those of `System`."""

import time
from typing import Any

from trade._calls.handle import Handle
from trade._container.system import System
from trade._context.call_context import current_call
from trade._services.decorator import service
from trade._services.withdrawn import WithdrawnInfo
from trade._telemetry.load import LoadInfo
from trade.protocol.container_info import ContainerInfo


class SystemServices:
    """The services of every container about itself."""

    def __init__(self, system: System) -> None:
        self._system = system

    @service(effect="read")
    def clock(self) -> int:
        """The monotonic clock of this container, in nanoseconds; the basis of every expiry."""
        return time.monotonic_ns()

    @service(effect="read")
    def containers(self) -> list[ContainerInfo]:
        """The containers that this one knows, itself included."""
        return self._system.containers()

    @service(effect="read")
    def load(self) -> LoadInfo:
        """The load of this container, its process and its host."""
        return self._system.load()

    @service
    def deregister(self, service: Handle) -> str:
        """Withdraws the provider of a service of this container; returns the name to register it with again."""
        return self._system.deregister(service)

    @service
    def register(self, provider: str, groups: tuple[str, ...] | None = None) -> tuple[Handle, ...]:
        """Offers an object again that was deregistered through this container, in other groups if given."""
        return self._system.register(provider, groups)

    @service(effect="read")
    def withdrawn(self) -> list[WithdrawnInfo]:
        """The providers that can be registered again, by name."""
        return self._system.withdrawn()

    @service
    def set_discovery(self, on: bool) -> None:
        """Switches discovery: links to all containers of the system that broadcast."""
        self._system.set_discovery(on)

    @service
    def set_broadcast(self, on: bool) -> None:
        """Switches broadcasting: answers the discovery of other containers of the system."""
        self._system.set_broadcast(on)

    @service
    def connect(self, endpoint: str) -> None:
        """Links to the container at an endpoint; CannotConnect if no container there accepts this one."""
        self._system.connect(endpoint)

    @service
    def disconnect(self, endpoint: str) -> None:
        """Stops dialling an endpoint; LinkStays if its link exists, which stays until one of its containers ends."""
        self._system.disconnect(endpoint)

    @service
    def load_policy(self, path: str) -> None:
        """Loads another access policy, or the same file again; a wrong one leaves the earlier one in force."""
        self._system.load_policy(path)

    @service
    def instantiate(
        self,
        class_path: str,
        args: tuple[Any, ...] | dict[str, Any] = (),
        groups: tuple[str, ...] = (),
        state: Any = None,
    ) -> tuple[Handle, ...]:
        """Create an object of a class that this container allows, give it its state if there is one, and offer it."""
        return self._system.instantiate(class_path, args, groups, state)

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
        return self._system.start_container(
            host, name, allow=allow, connect=connect, command=command, environment=environment
        )

    @service
    def add_code(self, archive: bytes) -> str:
        """Keep an archive of modules whose hash this container allows, and import from it; returns the hash."""
        return self._system.add_code(archive)

    @service
    def terminate(self, service: Handle) -> None:
        """End a provider that instantiate made here: what it moves stops, then it is closed."""
        self._system.terminate(service)

    @service
    def terminate_container(self, reason: str = "", only_at_rest: bool = False) -> list[str]:
        """End this container: stop what moves and withdraw its services; returns what could not be stopped, and why."""
        call = current_call()
        identity = "itself" if call is None else call.caller
        return self._system.terminate_container(reason, only_at_rest=only_at_rest, identity=identity)
