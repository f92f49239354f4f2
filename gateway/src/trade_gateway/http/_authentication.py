"""Who asks: by a token, by a certificate of the system's authority, or nobody that is known."""

from typing import Any, Final

from starlette.datastructures import Headers
from starlette.types import Scope

from trade.errors import AccessDenied
from trade_gateway.clients import ANONYMOUS, ClientAuthorizer
from trade_gateway.clients._errors import NotLetIn
from trade_gateway.http._tokens import Tokens

CERTIFIED: Final = "trade.certified"
"""In the scope: the common name of the certificate that the client has shown."""
SUBPROTOCOL: Final = "trade.v1"
_BEARER: Final = "bearer."


class Authenticator:
    """Identifies clients by token or certificate, and admits those that the policy has not revoked."""

    def __init__(self, tokens: Tokens, judge: ClientAuthorizer) -> None:
        self._tokens = tokens
        self._judge = judge

    def shown(self, scope: Scope) -> str:
        """The token that a request shows; empty if it shows none.

        In ``Authorization``, or, as pages cannot set that for a WebSocket, as subprotocol ``bearer.TOKEN``.
        """
        scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
        if scheme:
            return token.strip() if scheme.lower() == "bearer" else "?"
        offered: list[str] = scope.get("subprotocols", [])
        return next((one.removeprefix(_BEARER) for one in offered if one.startswith(_BEARER)), "")

    def who(self, scope: Scope) -> str:
        """The identity of whoever makes a request.

        Raises:
            NotLetIn: nobody, or a token that nobody has.
            AccessDenied: it is revoked.
        """
        who = self._identity(self.shown(scope), scope.get(CERTIFIED))
        if not self._judge.admits(who):
            raise AccessDenied(who=who, verb="call", what="the door", rule=f"{who} is revoked")
        return who

    def still(self, scope: Scope, who: str) -> bool:
        """Whether it is let in now as that identity."""
        try:
            return self.who(scope) == who
        except (NotLetIn, AccessDenied):
            return False

    def _identity(self, token: str, certified: Any) -> str:
        if token:
            known = self._tokens.who(token)
            if known is None:
                raise NotLetIn(reason="this token is nobody's, or was taken back")
            return known
        if isinstance(certified, str):
            return certified
        if self._judge.lets_anybody_in:
            return ANONYMOUS
        raise NotLetIn(reason="this door lets in nobody it does not know")
