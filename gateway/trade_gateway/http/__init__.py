"""The HTTP gateway: HTTP and WebSocket for clients without TRADE (the extra ``http``)."""

from trade_gateway.http._authentication import Tokens, add_token
from trade_gateway.http._server import HttpGateway

__all__ = ["HttpGateway", "Tokens", "add_token"]
