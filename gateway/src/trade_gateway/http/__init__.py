"""A door for those who speak nothing of ours: HTTP and WebSocket (the extra ``http``)."""

from trade_gateway.http._authentication import Tokens, add_token
from trade_gateway.http._server import Door

__all__ = ["Door", "Tokens", "add_token"]
