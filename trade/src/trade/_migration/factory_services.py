"""What every container offers about making objects and ending them, in group ``trade``."""

from typing import Any, Protocol

from trade._calls.handle import Handle
from trade._context.call_context import current_call
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
