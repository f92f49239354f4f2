"""Messages of every kind in bytes and what they mean: docs/wire-vectors.json, for containers in other languages.

Run as a program it writes the file again: after a change of the protocol that is meant.
"""

import json
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Raw, msgpack

from trade._resources.grants import Granted, LockInfo, LockRequest
from trade._resources.resource import Holder
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import (
    PROTOCOL,
    Behalf,
    Call,
    CancelArguments,
    ErrorInfo,
    Estop,
    EstopConfirmed,
    EstopOrder,
    Parameter,
    ProviderInfo,
    Reply,
    ServiceInfo,
    Status,
    Tally,
    Token,
)
from trade.protocol.samples import StreamSample

FILE: Final = Path(__file__).parents[3] / "docs" / "wire-vectors.json"
AT: Final = 1767225600.5
SESSION: Final = "anna/desk/4f2a91c07b3e"
CHANNEL: Final = "desk/4f2a91c07b3e.r"
ARM: Final = Address("rosie", "arm", "9c1d22aa70f3")


def _raw(value: Any) -> Raw:
    return Raw(msgpack.encode(value))


def _call(service: str, args: Any, *, expires_ns: int | None = 81_000_000_000, behalf: Behalf | None = None) -> Call:
    return Call(PROTOCOL, 4611686018427387905, service, CHANNEL, SESSION, expires_ns, (), _raw(args), behalf)


def _reply(status: int, body: Any = None) -> Reply:
    return Reply(PROTOCOL, 4611686018427387905, status, 80_000_000_123, _raw(body))


_TOKEN: Final = Token(ARM.epoch, 7)
_ESTOP: Final = Estop("5c0ffee5", SESSION, "smoke", AT)
_HOLDER: Final = Holder("anna", "desk", SESSION, "look around", AT, ("bob",))
_MOVE: Final = ServiceInfo(
    name="move_to",
    signature="(goal_rad: float) -> float",
    doc="Go there.",
    uses=("rosie.pan",),
    parameters=(Parameter("goal_rad"),),
    arguments_schema=_raw({"type": "object", "properties": {"goal_rad": {"type": "number"}}, "required": ["goal_rad"]}),
    result_schema=_raw({"type": "number"}),
)
_KEY: Final = ServiceKey(ARM, "rosie.neck", "pan", "move_to")
_HANDLE: Final = msgpack.Ext(1, msgpack.encode(_KEY))
_LOCKED: Final = ErrorInfo(
    type="trade.errors:LockedByOther",
    message="rosie.pan is locked by anna/desk for 'look around'",
    fields={"resources": ["rosie.pan"], "owner": "anna/desk", "purpose": "look around", "since": AT, "own": False},
)
_BEHALF: Final = Behalf(("bob/page/77aa00bb11cc/3",), (12, 11), (_TOKEN,))
_CHAINED: Final = Call(PROTOCOL, 1, "move_to", CHANNEL, SESSION, 81_000_000_000, ("rosie.look",), _raw([0.25]), _BEHALF)

MESSAGES: Final[dict[str, Any]] = {
    "a call": _call("move_to", [0.25]),
    "a call by name": _call("move_to", {"goal_rad": -0.25}),
    "a call on behalf of others, under a lock": _CHAINED,
    "a call that reads, without an expiry": _call(
        "echo", [None, True, -1, 2**63 - 1, "häß", b"\x00\xff"], expires_ns=None
    ),
    "a call with a handle": _call("relay", [_HANDLE, ["rosie.pan"], [0.25]]),
    "a call of stop": _call("stop", [], expires_ns=None),
    "a call of cancel": _call("cancel", CancelArguments(12, "rosie.neck.move_to", 8.0), expires_ns=None),
    "a call of acquire": _call("acquire", [["rosie.pan"], LockRequest(purpose="look around", wait_s=3.0)]),
    "a call of renew": _call("renew", [[7, 8]], expires_ns=None),
    "an answer": _reply(Status.OK, 0.25),
    "an answer with a map by number": _reply(Status.OK, {7: "its lease ended"}),
    "an error": _reply(Status.ERROR, _LOCKED),
    "a busy container": _reply(Status.BUSY),
    "a call that came too late": _reply(Status.EXPIRED),
    "no such service": _reply(Status.GONE),
    "progress": _reply(Status.PROGRESS, {"share": 0.5}),
    "what was granted": Granted(_TOKEN, ("rosie.pan",), 0.5),
    "what is locked": LockInfo(_TOKEN, "arm", ("rosie.pan",), _HOLDER, 1.5, 3, AT, ("bob/page",)),
    "a token": _TOKEN,
    "a handle": _HANDLE,
    "a tally": Tally(PROTOCOL, 3),
    "a provider": ProviderInfo(
        revision=2, groups=("rosie.neck",), kind="Motor", host="desk", pid=4711, services=(_MOVE,), kinds=("Motor",)
    ),
    "a provider that was deregistered": ProviderInfo(
        revision=3, groups=("rosie.neck",), kind="Motor", host="desk", pid=4711, services=()
    ),
    "an e-stop": _ESTOP,
    "an order to stop": EstopOrder(PROTOCOL, _ESTOP.id, _ESTOP),
    "an order to clear": EstopOrder(PROTOCOL, "c1ea12ed", None, (_ESTOP.id,)),
    "an order to stop of another version": EstopOrder(PROTOCOL + 1, _ESTOP.id, _ESTOP),
    "an order confirmed": EstopConfirmed(PROTOCOL, _ESTOP.id),
    "an order confirmed by another version": EstopConfirmed(PROTOCOL + 1, _ESTOP.id),
    "an order that failed": EstopConfirmed(PROTOCOL, _ESTOP.id, "rosie.pan still moves"),
    "a sample": StreamSample(PROTOCOL, 12, AT, 80_000_000_123, False, _raw(0.25)),
}
"""By name, one of every kind and of every turn it can take."""


def _field(message: Any, at: int, value: Any) -> list[Any]:
    fields = msgpack.decode(msgpack.encode(message))
    fields[at] = value
    return fields


_CALL: Final = MESSAGES["a call"]
_ORDER: Final = MESSAGES["an order to stop"]
DROPPED: Final[dict[str, tuple[str, bytes]]] = {
    "nothing": ("Call", b""),
    "no MessagePack": ("Call", b"\xc1"),
    "a call that was cut off": ("Call", msgpack.encode(_CALL)[:-1]),
    "a call and more": ("Call", msgpack.encode(_CALL) + b"\x00"),
    "a call that is a map": ("Call", msgpack.encode({"v": 1})),
    "a call of version 2": ("Call", msgpack.encode(_field(_CALL, 0, 2))),
    "a call without arguments": ("Call", msgpack.encode(_field(_CALL, 0, 1)[:7])),
    "a call with a text as its id": ("Call", msgpack.encode(_field(_CALL, 1, "12"))),
    "a call with a text as its expiry": ("Call", msgpack.encode(_field(_CALL, 5, "soon"))),
    "a call with a number as its behalf": ("Call", msgpack.encode([*_field(_CALL, 0, 1)[:8], 5])),
    "an array of a thousand million": ("Call", b"\xdd\x3b\x9a\xca\x00\x01"),
    "a reply of version 0": ("Reply", msgpack.encode(_field(MESSAGES["an answer"], 0, 0))),
    "a reply of an unknown status": ("Reply", msgpack.encode(_field(MESSAGES["an answer"], 2, 99))),
    "a tally of version 2": ("Tally", msgpack.encode([2, 3])),
    "a tally without a revision": ("Tally", msgpack.encode([1])),
    "an order of version 0": ("EstopOrder", msgpack.encode(_field(_ORDER, 0, 0))),
    "an order to clear of version 2": ("EstopOrder", msgpack.encode([2, "c1ea12ed", None, [_ESTOP.id]])),
    "an order of version 2 that is no e-stop": ("EstopOrder", msgpack.encode([2, _ESTOP.id, ["smoke"]])),
    "an order of version 2 of another client": (
        "EstopOrder",
        msgpack.encode([2, "5c0ffee5", ["5c0ffee5", "bob/page/77aa00bb11cc"]]),
    ),
    "a confirmation without a request": ("EstopConfirmed", msgpack.encode([2])),
    "an order under another name than its e-stop's": ("EstopOrder", msgpack.encode(_field(_ORDER, 1, "another"))),
    "an order that is no chunk": ("EstopOrder", msgpack.encode([1, "a/b", None, ["x"]])),
    "an order of another client": (
        "EstopOrder",
        msgpack.encode(EstopOrder(PROTOCOL, "5c0ffee5", Estop("5c0ffee5", "bob/page/77aa00bb11cc", "smoke", AT))),
    ),
}
"""What a reader drops; orders are those of anna."""


def document() -> dict[str, Any]:
    """The whole file."""
    return {
        "about": "Messages of the wire protocol (wire-protocol.md) in MessagePack, and what they mean.",
        "protocol": PROTOCOL,
        "notes": {
            "$bytes": "binary, in hexadecimal digits",
            "$extension": "an extension: its number and its data",
            "$map": "a map whose names are no texts: pairs",
            "dropped": "what a reader drops: bytes put where a message of that kind is due; orders on estop/anna",
        },
        "messages": [
            {"name": name, "kind": kind_of(message), "hex": msgpack.encode(message).hex(), "meaning": _meaning(message)}
            for name, message in MESSAGES.items()
        ],
        "dropped": [{"name": name, "kind": kind, "hex": data.hex()} for name, (kind, data) in DROPPED.items()],
    }


def text() -> str:
    """The current file."""
    return json.dumps(document(), indent=1, ensure_ascii=False) + "\n"


def kind_of(message: Any) -> str:
    """What the page calls it."""
    return "Handle" if isinstance(message, msgspec.msgpack.Ext) else type(message).__name__


def _meaning(message: Any) -> Any:
    return _reported(msgpack.decode(msgpack.encode(message), strict=False))


def _reported(value: Any) -> Any:
    if isinstance(value, bytes):
        return {"$bytes": value.hex()}
    if isinstance(value, msgpack.Ext):
        return {"$extension": [value.code, bytes(value.data).hex()]}
    if isinstance(value, list):
        return [_reported(one) for one in value]
    if isinstance(value, dict):
        if all(isinstance(name, str) for name in value):
            return {name: _reported(one) for name, one in value.items()}
        return {"$map": [[_reported(name), _reported(one)] for name, one in value.items()]}
    return value


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
