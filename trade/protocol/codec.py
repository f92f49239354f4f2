"""Encodes and decodes values, with a container's own encoding of handles."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from trade.protocol.schema import type_text


class Codec:
    """Encoding and decoding of values, with the container's conversion of handles."""

    def __init__(
        self, enc_hook: Callable[[Any], Any], ext_hook: Callable[[int, memoryview], Any], own: Sequence[type] = ()
    ) -> None:
        self._ext_hook = ext_hook
        self._own = tuple(own)
        """Types that only the hooks can encode."""
        self.encode: Callable[[Any], bytes] = msgspec.msgpack.Encoder(enc_hook=enc_hook).encode

    def decoder(self, type_: Any) -> Callable[[Any], Any]:
        """A decoder for one type; raises msgspec.ValidationError."""
        return msgspec.msgpack.Decoder(type_, dec_hook=_as_it_is, ext_hook=self._ext_hook).decode

    def schema(self, type_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """JSON Schema of a type and of the types it refers to; raises TypeError for one that cannot be sent."""
        [schema], definitions = msgspec.json.schema_components([type_], schema_hook=self._own_schema)
        return schema, dict(definitions)

    def _own_schema(self, type_: Any) -> dict[str, Any]:
        if type_ not in self._own:
            raise TypeError(f"{type_text(type_)} is no plain data")
        return {"type": "object", "title": type_.__name__, "x-trade-type": type_.__name__}


def _as_it_is(type_: type, value: Any) -> Any:
    """Accepts values of types that msgspec does not know: the ext hook has already made them (handles)."""
    if isinstance(value, type_):
        return value
    raise TypeError(f"Expected `{type_.__name__}`, got `{type(value).__name__}`")
