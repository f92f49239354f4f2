"""Queries in memory: a query goes to one node, its replies come back, and neither takes time."""

from typing import TYPE_CHECKING

from trade._transport.base import Answer, ChannelClosed, Message, Question
from trade._transport.memory.keys import meet
from trade._transport.memory.links import Kind
from trade._transport.memory.node import MemoryQuestions, Node

if TYPE_CHECKING:
    from trade._transport.memory.network import Network


class MemoryQuestion(Question):
    """One query to one node."""

    def __init__(self, network: "Network", source: Node, target: Node, pattern: str, asked: MemoryQuestions) -> None:
        self.collected = Answer(f"{target.name}-{network.next_number()}", [])
        self._network = network
        self._source = source
        self._target = target
        self._pattern = pattern
        self._asked = asked
        self._closed = False

    def send(self) -> None:
        """Send the query. Used under the network's lock."""
        message = Message(self._pattern, None)
        self._network.pass_on(
            Kind.ASK, self._source, self._target, message, lambda: self._asked.take(self), at_once=True
        )

    @property
    def ended(self) -> bool:
        """Whether no more replies will come; used under the network's lock."""
        return self._closed or not self._network.linked(self._source, self._target)

    def answer(self, key: str, payload: bytes) -> None:
        with self._network.lock:
            if self.ended:
                raise ChannelClosed
            if meet(self._pattern, key):
                message = Message(key, payload)
                self._network.pass_on(
                    Kind.ANSWER,
                    self._target,
                    self._source,
                    message,
                    lambda: self.collected.messages.append(message),
                    at_once=True,
                )

    def close(self) -> None:
        with self._network.lock:
            self._closed = True
            self._network.changed.notify_all()
