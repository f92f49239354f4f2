"""What the parts of a container have in common."""

from abc import ABC, abstractmethod
from typing import Any

from trade._calls.handle import Handle
from trade._calls.run import Run
from trade._container.assembly import Components
from trade._protocol.keys import Address, ServiceKey
from trade._registry.registry import Record
from trade._security.authorizer import Authorizer
from trade._settings import Settings


class Member(ABC):
    """A container, as its parts see it: one part hosts, one looks up and calls, one guards."""

    settings: Settings
    address: Address
    session: str
    access: Authorizer
    _parts: Components

    @abstractmethod
    def _check_open(self) -> None:
        """Raises ConfigurationError if it is closed, or if this is a forked child."""

    @property
    @abstractmethod
    def closed(self) -> bool:
        """Whether it was closed."""

    @abstractmethod
    def addresses(self) -> list[Address]:
        """Where the containers of the system are, this one included."""

    @abstractmethod
    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""

    @abstractmethod
    def has(self, key: ServiceKey) -> bool:
        """Whether the registry has the service now."""

    @abstractmethod
    def record(self, handle: Handle) -> Record:
        """What is known of a service; raises ServiceGone if nothing ever was."""

    @abstractmethod
    def asked_for(self, handle: Handle) -> tuple[str, tuple[str, ...]]:
        """The verb that callers of a service need over its group, and the roles of the policy here that have it."""

    @abstractmethod
    def invoke(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Any:
        """Call a service and wait; what ``handle(...)`` does."""

    @abstractmethod
    def begin(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Run:
        """Call a service without waiting; what ``handle.start(...)`` does."""
