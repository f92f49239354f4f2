"""Pictures of cameras as resources of an agent: listed without a request to the camera, taken when they are read."""

import time
from collections.abc import Callable
from typing import Final

import msgspec
from mcp import McpError
from mcp.server.lowlevel.helper_types import ReadResourceContents
from mcp.types import ErrorData, Resource
from pydantic import AnyUrl

from trade import Handle
from trade.errors import InvalidResult, NoSuchService, TooLarge, TradeError
from trade_gateway.clients import Client, ClientApi
from trade_gateway.clients import _schemas as messages

MOST_PICTURE_BYTES: Final = 4 << 20
_SCHEME: Final = "trade"
_NO_GROUP: Final = "_"
_NOT_FOUND: Final = -32002
"""The code of MCP for a resource that does not exist."""
_FAILED: Final = -32603

Record = Callable[[str, str, int, str, str], None]


class Pictures:
    """The pictures that an agent may see.

    Args:
        api: the operations of clients.
        client: the agent.
        record: audits what was read.
    """

    def __init__(self, api: ClientApi, client: Client, record: Record) -> None:
        self._api = api
        self._client = client
        self._record = record

    async def listed(self) -> list[Resource]:
        """Returns a resource for each camera that the agent may read."""
        return [Resource(uri=AnyUrl(_uri(one)), name=one.label, description=one.doc or None) for one in self._cameras()]

    async def read(self, uri: AnyUrl) -> list[ReadResourceContents]:
        """Returns a picture that is taken now. Raises McpError."""
        began, address = time.monotonic_ns(), str(uri)
        try:
            content = await self._take(address)
        except Exception as error:
            name, why = type(error).__name__, str(error) if isinstance(error, TradeError) else ""
            self._record("picture", address, began, name, why)
            code = _NOT_FOUND if isinstance(error, NoSuchService) else _FAILED
            raise McpError(ErrorData(code=code, message=f"{name}: {error}")) from error
        self._record("picture", address, began, "ok", "")
        return [content]

    async def _take(self, address: str) -> ReadResourceContents:
        camera = next((one for one in self._cameras() if _uri(one) == address), None)
        if camera is None:
            raise NoSuchService(constraint=f"picture {address}")
        run = await self._api.begin(self._client, camera, messages.CallBody(), self._client.admit(camera))
        await run.settled()
        match msgspec.to_builtins(run.result(0), builtin_types=(bytes,)):
            case {"format": ("jpeg" | "png") as kind, "data": bytes() as data}:
                if len(data) > MOST_PICTURE_BYTES:
                    limit = MOST_PICTURE_BYTES
                    raise TooLarge(service=camera.label, what="a picture", size_bytes=len(data), limit_bytes=limit)
                return ReadResourceContents(content=data, mime_type=f"image/{kind}")
            case _:
                raise InvalidResult(service=camera.label, problem="it is no JPEG or PNG picture. Use the tool `call`")

    def _cameras(self) -> list[Handle]:
        who = self._client.identity
        seen = self._api.seen(who)
        return [one for one in seen if one.effect == "read" and _is_camera(one) and self._api.judge.may_call(who, one)]


def _uri(camera: Handle) -> str:
    return f"{_SCHEME}://{camera.container}/{camera.key.domain or _NO_GROUP}/{camera.name}"


def _is_camera(handle: Handle) -> bool:
    """Whether a service returns a picture and needs no argument."""
    schema = handle.schema
    result = schema["result"]
    known = result.get("$defs", {}).get(str(result.get("$ref", "")).rpartition("/")[2], {}).get("properties", {})
    is_picture = "format" in known and known.get("data", {}).get("contentEncoding") == "base64"
    return is_picture and not schema["arguments"].get("required")
