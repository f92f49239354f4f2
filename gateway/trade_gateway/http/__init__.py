"""The HTTP gateway: HTTP and WebSocket for clients without TRADE (the extra ``http``)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from trade_gateway.http._authentication import Tokens, add_token
    from trade_gateway.http._server import HttpGateway

__all__ = ["HttpGateway", "Tokens", "add_token"]

_PLACES: Final = {
    "Tokens": "_authentication",
    "add_token": "_authentication",
    "HttpGateway": "_server",
}
"""The modules of these names; they need the extra ``http``, which the command line is installed without."""


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(name)
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
