"""The HTTP gateway: HTTP and WebSocket for clients without TRADE (the extra ``http``)."""

from trade_gateway.http._authentication import Tokens, add_token
from trade_gateway.http._server import Door

__all__ = ["Door", "Tokens", "add_token"]
