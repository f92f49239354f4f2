"""The HTTP gateway: HTTP and WebSocket for clients without TRADE (the extra ``http``)."""

from typing import TYPE_CHECKING

from trade_gateway._lazy_names import lazy_names

if TYPE_CHECKING:
    from trade_gateway.http._authentication import Tokens, add_token
    from trade_gateway.http._server import HttpGateway

__all__ = ["HttpGateway", "Tokens", "add_token"]

# their modules need the extra `http`, which the command line is installed without
__getattr__ = lazy_names(
    __name__,
    {
        "Tokens": "_authentication",
        "add_token": "_authentication",
        "HttpGateway": "_server",
    },
)
