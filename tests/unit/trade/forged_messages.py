"""What a container that is none says on the wire."""

from typing import Any

import msgspec

from trade import Container, Handle, where
from trade.protocol.keys import Address, alive_key, calls_to, registry_key, reply_key
from trade.protocol.messages import (
    PROTOCOL,
    Call,
    ProviderInfo,
    Reply,
    ServiceInfo,
    Status,
    decode_call,
    encode_message,
)
from trade.protocol.schema import schema_message

FUTURE = 99
"""A version of the protocol that does not exist."""
TEXT, NUMBER = schema_message({"type": "string"}, {}), schema_message({"type": "integer"}, {})
FORGED = Address("mallory", "ghost", "e1")
PROVIDER = ProviderInfo(
    revision=1, groups=("forged",), kind="Forged", host="h", pid=1, services=(ServiceInfo(name="go", signature="go()"),)
)


class FakeCallee:
    """Shows itself like a container, and answers as the test says."""

    def __init__(self, raw: Any, caller: Container) -> None:
        self.raw, self.caller = raw, caller
        self.calls = raw.subscribe(calls_to(FORGED, stop=False))
        info = ServiceInfo(name="go", signature="go() -> int", effect="read", result_schema=NUMBER)
        self.sign = raw.appear(alive_key(FORGED))
        self.describe(msgspec.structs.replace(PROVIDER, services=(info,)))
        self.handle: Handle = caller.find(where(group="forged"), wait_s=20)

    def describe(self, entry: ProviderInfo) -> None:
        registry = self.caller._parts.registry
        assert registry.wait_for(lambda: registry.is_alive(FORGED), 20)
        self.raw.announce(registry_key("robot", FORGED, "P-1"), encode_message(entry))

    def answer_clock(self) -> None:
        self.answer(self.next(), Status.OK)

    def next(self) -> Call:
        return decode_call(self.calls.receive().payload)

    def answer(self, call: Call, status: int, body: Any = None, *, speaker: str = "mallory", **more: Any) -> None:
        raw_body = msgspec.Raw(encode_message(body))
        self.put(
            call, encode_message(Reply(more.get("v", PROTOCOL), more.get("id", call.id), status, 1, raw_body)), speaker
        )

    def put(self, call: Call, payload: bytes, speaker: str = "mallory") -> None:
        container, channel = call.reply.split("/")
        self.raw.publish(reply_key(speaker, self.caller.address.identity, container, channel)).put(payload)
