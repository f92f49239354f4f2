"""A door for those who speak nothing of ours: HTTP and WebSocket (the extra ``http``)."""

from trade_gateway.http._server import Door
from trade_gateway.http._tokens import Tokens, add_token

__all__ = ["Door", "Tokens", "add_token"]
