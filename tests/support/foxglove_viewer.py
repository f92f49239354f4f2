"""A viewer of live data, by the specification of the Foxglove WebSocket protocol and the library ``websockets``."""

import json
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

import jsonschema_rs
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.support.waiting import PATIENCE_S

PROTOCOL: Final = Subprotocol("foxglove.sdk.v1")
MESSAGE_DATA: Final = 1
UNKNOWN: Final = "nknown channel"
"""What the server answers, and logs, if a viewer subscribes sooner than the server has noted its own offer."""


class Viewer:
    """Speaks the protocol as its specification has it: JSON texts, and binary frames of messages."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.withdrawn: list[int] = []
        self._topics: dict[int, str] = {}
        self._numbers: dict[int, int] = {}
        """The number of the subscription of each channel."""
        self.info = self._read()

    def _read(self) -> Any:
        return json.loads(self._socket.recv(PATIENCE_S))

    def hear(self) -> dict[str, Any]:
        """The next text; what is offered is noted."""
        said = self._read()
        self._note(said)
        return said

    def _note(self, said: dict[str, Any]) -> None:
        if said["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        elif said["op"] == "unadvertise":
            self.withdrawn += said["channelIds"]
        elif said["op"] == "status" and UNKNOWN in said["message"]:  # foxglove-sdk 0.30 offers before it notes
            refused = int(said["message"].rpartition(":")[2])
            self._subscribe(self._numbers[refused], refused)

    def subscribe(self, topic: str) -> None:
        while topic not in self.channels:
            self.hear()
        number, channel = 100 + len(self._topics), self.channels[topic]["id"]
        self._topics[number], self._numbers[channel] = topic, number
        self._subscribe(number, channel)

    def _subscribe(self, number: int, channel: int) -> None:
        self.send({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel}]})

    def send(self, said: dict[str, Any]) -> None:
        self._socket.send(json.dumps(said))

    def message(self) -> tuple[str, int, dict[str, Any]]:
        """Topic, time in ns and contents of the next message, which is as its schema says."""
        while isinstance(frame := self._socket.recv(PATIENCE_S), str):
            self._note(json.loads(frame))
        assert frame[0] == MESSAGE_DATA
        topic = self._topics[int.from_bytes(frame[1:5], "little")]
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        value = json.loads(frame[13:])
        jsonschema_rs.validate(json.loads(channel["schema"]), value)
        return topic, int.from_bytes(frame[5:13], "little"), value


@contextmanager
def viewer(url: str, **options: Any) -> Generator[Viewer]:
    with connect(url, subprotocols=[PROTOCOL], compression=None, max_size=None, **options) as socket:
        yield Viewer(socket)
