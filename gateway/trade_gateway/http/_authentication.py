"""Identifies clients: by a token, by a certificate of the system's authority, or not at all."""

import hashlib
import logging
import secrets
from pathlib import Path
from typing import Any, Final, cast

import tomlkit
from starlette.datastructures import Headers
from starlette.types import Scope
from tomlkit.exceptions import TOMLKitError

from trade.atomic_files import replace
from trade.errors import AccessDenied, ConfigurationError
from trade.protocol.keys import is_chunk
from trade.text_files import as_before, read_text
from trade_gateway.clients import ANONYMOUS, ClientAuthorizer
from trade_gateway.clients._errors import NotAuthenticated

_logger = logging.getLogger("trade")

_TABLE: Final = "tokens"
_BYTES: Final = 32
"""A token has enough random bytes that its hash needs neither salt nor a slow function."""
_HEAD: Final = "# A client that sends a token has its identity. Remove a line to revoke the token.\n"


def add_token(path: Path, identity: str) -> str:
    """Creates a token for an identity, and adds it to the file, which it creates if necessary.

    Raises:
        ConfigurationError: this is not a valid identity, or the file cannot be read or written.
    """
    if not is_chunk(identity):
        problem = f"{identity!r} is no identity. Use at most 80 letters, digits, . _ -"
        raise ConfigurationError(where="token", problem=problem)
    known = _read(path) if path.exists() else {}
    token = secrets.token_urlsafe(_BYTES)
    text = tomlkit.dumps({_TABLE: {**known, _hash(token): identity}})
    try:
        replace(path, as_before(path.read_bytes() if path.exists() else b"", _HEAD + text))
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be written ({bad.strerror})") from None
    return token


class Tokens:
    """The tokens in a file at this moment; none without a file. The file has only their hashes."""

    def __init__(self, path: Path | None) -> None:
        """Raises ConfigurationError: the file cannot be read, or is invalid."""
        self._path = path
        self._seen = _seen(path)
        self._known = {} if path is None else _read(path)

    def __bool__(self) -> bool:
        return bool(self._known)

    def who(self, token: str) -> str | None:
        """The identity of a token; None if the token is not in the file, or not any more."""
        self._look()
        return self._known.get(_hash(token))

    def _look(self) -> None:
        """Reads a changed file again; logs an invalid one, and keeps the earlier tokens."""
        if self._path is None or (seen := _seen(self._path)) == self._seen:
            return
        self._seen = seen
        try:
            self._known = _read(self._path)
        except ConfigurationError as wrong:
            _logger.warning("the tokens file is invalid, so the earlier tokens remain valid: %s", wrong)


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
        known: Any = tomlkit.parse(read_text(path)).unwrap().get(_TABLE, {})
    except OSError as bad:
        problem = f"cannot be read ({bad.strerror}). `trade http token NAME` creates a token and the file"
        raise ConfigurationError(where=str(path), problem=problem) from None
    except (TOMLKitError, UnicodeDecodeError) as bad:
        raise ConfigurationError(where=str(path), problem=f"is not TOML: {bad}") from None
    if not isinstance(known, dict):
        problem = f"{_TABLE} must be a table: [{_TABLE}]"
        raise ConfigurationError(where=str(path), problem=problem)
    for digest, identity in cast("dict[str, object]", known).items():
        if len(digest) != hashlib.sha256().digest_size * 2 or not isinstance(identity, str) or not is_chunk(identity):
            problem = "each line of [tokens] must be the SHA-256 of a token = its identity"
            raise ConfigurationError(where=f"{path}, {digest}", problem=problem)
    return cast("dict[str, str]", known)


CERTIFIED: Final = "trade.certified"
"""Key in the scope: the common name of the client's certificate."""
SUBPROTOCOL: Final = "trade.v1"
_BEARER: Final = "bearer."


class Authenticator:
    """Identifies clients by token or certificate, and admits those that the policy has not revoked."""

    def __init__(self, tokens: Tokens, judge: ClientAuthorizer) -> None:
        self._tokens = tokens
        self._judge = judge

    def shown(self, scope: Scope) -> str:
        """The token in a request; empty without one.

        It is in ``Authorization``; or in the subprotocol ``bearer.TOKEN``, as pages cannot set headers of a WebSocket.
        """
        scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
        if scheme:
            return token.strip() if scheme.lower() == "bearer" else "?"
        offered: list[str] = scope.get("subprotocols", [])
        return next((one.removeprefix(_BEARER) for one in offered if one.startswith(_BEARER)), "")

    def who(self, scope: Scope) -> str:
        """The identity of a request's client.

        Raises:
            NotAuthenticated: it has no identity, or its token is unknown.
            AccessDenied: the identity is revoked.
        """
        who = self._identity(self.shown(scope), scope.get(CERTIFIED))
        if not self._judge.admits(who):
            raise AccessDenied(who=who, verb="call", what="the HTTP gateway", rule=f"{who} is revoked")
        return who

    def still(self, scope: Scope, identity: str) -> bool:
        """Whether the client is still admitted as that identity."""
        try:
            return self.who(scope) == identity
        except (NotAuthenticated, AccessDenied):
            return False

    def _identity(self, token: str, certified: Any) -> str:
        if token:
            known = self._tokens.who(token)
            if known is None:
                raise NotAuthenticated(reason="this token is unknown or revoked")
            return known
        if isinstance(certified, str):
            return certified
        if self._judge.lets_anybody_in:
            return ANONYMOUS
        raise NotAuthenticated(reason="the HTTP gateway admits no clients without an identity")
