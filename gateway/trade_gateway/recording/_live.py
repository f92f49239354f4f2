"""A sink that shows messages live to viewers over the Foxglove WebSocket protocol."""

import logging
import queue
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import foxglove
import msgspec
from foxglove.websocket import ChannelView, Client, ServerListener

from trade.errors import ConfigurationError
from trade_gateway.process._addresses import in_url
from trade_gateway.recording._channels import FAULTS, LOCKS, Channel, Fault, FaultKind, Message

_OUTBOX: Final = 256
"""Most messages that wait for a slow viewer; beyond that the oldest are dropped."""
_KEEP_NOTICES: Final = 100
_LOGGER: Final = "foxglove"
_BEHIND: Final = "foxglove.websocket.connected_client.send_lossy"
_fault: Final = msgspec.json.Decoder(Fault).decode


class Live:
    """A WebSocket server that only sends: it has no parameters and no services, and accepts no messages of viewers.

    ``write`` never waits. Used by one thread; a context manager.
    """

    def __init__(self, host: str, port: int, name: str, outbox: int = _OUTBOX) -> None:
        """Starts to listen.

        Args:
            host: the address; the protocol has no login.
            port: 0 selects a free one.
            name: the name that viewers show.
            outbox: most messages that wait for a viewer.

        Raises:
            ConfigurationError: the address cannot be used.
        """
        self._notices = _ServerLog()
        self._newcomers = _NewSubscriptions()
        self._context = foxglove.Context()
        self._channels: dict[str, tuple[Channel, foxglove.Channel]] = {}
        self._locks: Message | None = None
        self._faults: dict[tuple[str, FaultKind], Message] = {}
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                context=self._context,
                server_listener=self._newcomers,
                message_backlog_size=outbox,
            )
        except RuntimeError as bad:
            self._notices.close()
            raise ConfigurationError(where=f"{in_url(host)}:{port}", problem=f"cannot be used: {bad}") from None
        self.url: Final = f"ws://{in_url(host)}:{self._server.port}"
        """The address for viewers."""

    def write(self, message: Message) -> None:
        """Sends a message to all subscribers of its channel."""
        if message.channel is LOCKS:
            self._locks = message
        elif message.channel is FAULTS:
            self._keep(message)
        self._channel(message.channel).log(message.data, log_time=message.arrived_ns)
        self.greet()

    def greet(self) -> None:
        """Sends the current locks and faults to new subscribers, as the next message only follows a change."""
        for viewer, topic in self._newcomers.take():
            for message in self._standing(topic):
                channel = self._channel(message.channel)
                channel.log(message.data, log_time=message.arrived_ns, sink_id=viewer)

    def _standing(self, topic: str) -> list[Message]:
        if topic == LOCKS.topic:
            return [] if self._locks is None else [self._locks]
        return list(self._faults.values()) if topic == FAULTS.topic else []

    def _keep(self, message: Message) -> None:
        fault = _fault(message.data)
        if fault.text:
            self._faults[fault.about, fault.kind] = message
        else:
            self._faults.pop((fault.about, fault.kind), None)

    def _channel(self, channel: Channel) -> foxglove.Channel:
        """Returns the channel of a topic; a message with another schema replaces the channel."""
        known = self._channels.get(channel.topic)
        if known is not None and known[0] == channel:
            return known[1]
        if known is not None:
            known[1].close()
        schema = foxglove.Schema(name=channel.schema_name, encoding="jsonschema", data=channel.schema)
        made = foxglove.Channel(channel.topic, schema=schema, message_encoding="json", context=self._context)
        self._channels[channel.topic] = channel, made
        return made

    @property
    def behind(self) -> int:
        """How often the server reported a slow viewer that missed messages: at most twice a minute in all."""
        return self._notices.behind

    def notices(self) -> Iterator[str]:
        """Yields the server's reports on viewers since the last time."""
        yield from self._notices.take()

    def close(self) -> None:
        """Disconnects all viewers. Idempotent."""
        self._server.stop()
        for _, channel in self._channels.values():
            channel.close()
        self._channels.clear()
        self._notices.close()

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _NewSubscriptions(ServerListener):
    """New subscriptions; a thread of the server adds them, ours takes them."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._queue.put((client.id, channel.topic))

    def take(self) -> Iterator[tuple[int, str]]:
        with suppress(queue.Empty):
            while True:
                yield self._queue.get_nowait()


class _ServerLog(logging.Handler):
    """Collects the server's log, its only report on viewers that are slow or were rejected."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: queue.Queue[str] = queue.Queue(_KEEP_NOTICES)
        self.behind = 0
        logger = logging.getLogger(_LOGGER)
        logger.propagate = False
        logger.setLevel(logging.INFO)
        logger.addHandler(self)
        foxglove.set_log_level("INFO")

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.name == _BEHIND:
            self.behind += 1
            text = f"a viewer is too slow and misses messages ({text})"
        elif record.levelno < logging.WARNING:
            return
        with suppress(queue.Full):
            self._lines.put_nowait(text)

    def take(self) -> Iterator[str]:
        with suppress(queue.Empty):
            while True:
                yield self._lines.get_nowait()

    def close(self) -> None:
        logging.getLogger(_LOGGER).removeHandler(self)
        super().close()
