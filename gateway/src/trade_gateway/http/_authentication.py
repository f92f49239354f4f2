"""Identifies clients: by a token, by a certificate of the system's authority, or not at all."""

import hashlib
import logging
import os
import secrets
from pathlib import Path
from typing import Any, Final, cast

import tomlkit
from starlette.datastructures import Headers
from starlette.types import Scope
from tomlkit.exceptions import TOMLKitError

from trade._protocol.keys import is_chunk
from trade.errors import AccessDenied, ConfigurationError
from trade_gateway.clients import ANONYMOUS, ClientAuthorizer
from trade_gateway.clients._errors import NotLetIn

_logger = logging.getLogger("trade")

_TABLE: Final = "tokens"
_BYTES: Final = 32
"""So many random ones in a token that its hash needs no salt and no slowness."""
_HEAD: Final = "# Whoever shows a token is that identity. A line taken out takes the token back.\n"


def add_token(path: Path, identity: str) -> str:
    """Make a token for an identity, and note it in the file, which need not be there yet.

    Raises:
        ConfigurationError: no identity has such a name, or the file cannot be read or written.
    """
    if not is_chunk(identity):
        problem = f"{identity!r} is no identity; use letters, digits, . _ - (at most 80)"
        raise ConfigurationError(where="token", problem=problem)
    known = _read(path) if path.exists() else {}
    token = secrets.token_urlsafe(_BYTES)
    text = tomlkit.dumps({_TABLE: {**known, _hash(token): identity}})
    beside = path.with_name(f".{path.name}.new")
    try:
        with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(_HEAD + text)
        beside.replace(path)
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be written ({bad.strerror})") from None
    return token


class Tokens:
    """The tokens in a file, as it is now; without a file none. The file has their hashes alone."""

    def __init__(self, path: Path | None) -> None:
        """Raises ConfigurationError: the file cannot be read, or is wrong."""
        self._path = path
        self._seen = _seen(path)
        self._known = {} if path is None else _read(path)

    def __bool__(self) -> bool:
        return bool(self._known)

    def who(self, token: str) -> str | None:
        """The identity that a token is for; None for one that is not, or no longer, in the file."""
        self._look()
        return self._known.get(_hash(token))

    def _look(self) -> None:
        """Read the file again if it was changed; what is wrong with it is said, and the tokens stay as they were."""
        if self._path is None or (seen := _seen(self._path)) == self._seen:
            return
        self._seen = seen
        try:
            self._known = _read(self._path)
        except ConfigurationError as wrong:
            _logger.warning("the tokens stay as they were: %s", wrong)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()


def _seen(path: Path | None) -> tuple[int, ...]:
    try:
        found = None if path is None else path.stat()
    except OSError:
        found = None
    return () if found is None else (found.st_mtime_ns, found.st_size, found.st_ino)


def _read(path: Path) -> dict[str, str]:
    try:
        known: Any = tomlkit.parse(path.read_text(encoding="utf-8")).unwrap().get(_TABLE, {})
    except OSError as bad:
        problem = f"cannot be read ({bad.strerror}); trade door token NAME makes a token and the file"
        raise ConfigurationError(where=str(path), problem=problem) from None
    except (TOMLKitError, UnicodeDecodeError) as bad:
        raise ConfigurationError(where=str(path), problem=f"is no TOML: {bad}") from None
    if not isinstance(known, dict):
        problem = f"{_TABLE} must be a table: [{_TABLE}]"
        raise ConfigurationError(where=str(path), problem=problem)
    for digest, identity in cast("dict[str, object]", known).items():
        if len(digest) != hashlib.sha256().digest_size * 2 or not isinstance(identity, str) or not is_chunk(identity):
            problem = "each line of [tokens] is the SHA-256 of a token = the identity that it is for"
            raise ConfigurationError(where=f"{path}, {digest}", problem=problem)
    return cast("dict[str, str]", known)


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
