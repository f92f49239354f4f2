"""What clients of an HTTP gateway and agents say."""

from typing import Any, Final

import msgspec

from tests.endurance.fuzz._target import Target
from trade_gateway.clients import _changes as changes
from trade_gateway.clients import _schemas as messages
from trade_gateway.mcp._tools import TOOLS

_BODIES: Final = [
    messages.CallBody,
    messages.LockBody,
    messages.GroupBody,
    messages.RequestBody,
    messages.EstopBody,
    messages.ClearBody,
    messages.SwitchBody,
    messages.SessionBody,
    changes.ReasonBody,
    changes.MigrateBody,
    changes.ProviderBody,
    changes.InstantiateBody,
    changes.FileBody,
]
_REFUSED: Final = (msgspec.DecodeError, ValueError, RecursionError)
"""What the HTTP gateway answers with BadMessage."""


def _frame(data: bytes) -> Any:
    """A message of the WebSocket, as the HTTP gateway takes it."""
    asked = messages.read(data, messages.ASKED)
    messages.numbers(getattr(asked, "args", None))
    return asked


def _body(data: bytes) -> Any:
    """The first byte says of which request."""
    kind = _BODIES[data[0] % len(_BODIES)] if data else _BODIES[0]
    return msgspec.json.decode(data[1:] or b"{}", type=kind)


def _tool(data: bytes) -> Any:
    """The first byte says of which tool; its arguments have come as JSON."""
    tool = list(TOOLS.values())[data[0] % len(TOOLS)] if data else next(iter(TOOLS.values()))
    given = msgspec.json.decode(data[1:])
    return msgspec.convert(messages.numbers(given), tool.asked)


TARGETS: Final = [
    Target("http-frame", _frame, _REFUSED, messages.encoder.encode),
    Target("http-body", _body, _REFUSED),
    Target("agent-tool", _tool, _REFUSED),
]
