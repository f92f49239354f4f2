"""What actions need of the node of ROS 1: its topics."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from trade_gateway.ros.ros1._link import Opened
from trade_gateway.ros_messages._types import Message, Types

HeardAt = Callable[[Message, str, float], object]
"""Called with a message, its sender, and the time of arrival by ``time.monotonic()``."""


@dataclass(frozen=True, eq=False)
class PublishedTopic:
    """A topic that the node publishes."""

    types: Types
    type_name: str
    opened: Opened

    def send(self, message: Mapping[str, Any]) -> None:
        self.opened.send(self.types.to_bytes(self.type_name, message))

    def close(self) -> None:
        self.opened.close()


class Topics(Protocol):
    """The topics of a node."""

    @property
    def node(self) -> str:
        """The node's name."""
        ...

    @property
    def types(self) -> Types:
        """The types of messages."""
        ...

    def publish(self, topic: str, type_name: str, *, latched: bool, most: int) -> PublishedTopic:
        """Publishes; at most `most` messages wait, the newest ones."""
        ...

    def hear(
        self, topic: str, type_name: str, callback: HeardAt, *, most: int, latched: bool = True
    ) -> tuple[Opened, tuple[Callable[[], object], ...]]:
        """Subscribes; at most `most` messages wait, the newest ones. Returns the steps that end it, too."""
        ...

    def connected(self, what: str, opened: Iterable[Opened], timeout_s: float) -> list[set[str]]:
        """The nodes at the other ends of each of these topics. Raises RosUnreachable."""
        ...
