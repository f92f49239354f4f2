"""The service of the stop line: it authorises requests, carries them out, and answers."""

import contextlib
import logging
import socket
import ssl
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from trade._audit.events import Audit
from trade._estop.controller import EstopController
from trade._security.authorizer import Authorizer
from trade._security.certificates import Certificate, line_context
from trade._settings import Settings
from trade.errors import LimitExceeded, TradeError
from trade.protocol.keys import Address
from trade.protocol.messages import Malformed
from trade.stop_line.group_stop import StopReport
from trade.stop_line.listener import Listener
from trade.stop_line.messages import StopAnswer, StopRequest, encoded, estop_fields, read_request
from trade.stop_line.places import host_socket, network_socket
from trade.transport.endpoints import Endpoint
from trade.transport.host_socket import is_deaf

_logger = logging.getLogger("trade")

MOST_OF_ONE: Final = 8
"""The most concurrent requests of one identity."""
MOST: Final = 64
"""The most concurrent requests."""
_ANSWER_S: Final = 1.0


class StopLineService:
    """Listens on the networks from the start, and on this host when there is something to stop.

    Args:
        stop: calls all known stop services of a group for a client, within a time limit in seconds.

    Raises:
        ConfigurationError: one of its ports cannot be opened.
    """

    def __init__(
        self,
        own: Address,
        settings: Settings,
        access: Authorizer,
        audit: Audit,
        estop: EstopController,
        stop: Callable[[str, str, float], StopReport],
    ) -> None:
        self._own = own
        self._system = settings.system
        self._access = access
        self._audit = audit
        self._estop = estop
        self._stop = stop
        self._guard = threading.Lock()
        self._busy: Counter[str] = Counter()
        self._listeners: list[Listener] = []
        self._path: Path | None = None
        self._on_host: Listener | None = None
        self._listens_on_host = False
        """Whether it has to listen on this host."""
        self._warned = False
        self._closed = False
        certificate = settings.certificate()
        if certificate is not None and (servers := _network_sockets(settings, certificate)):
            self._listeners.append(Listener(servers, self._serve))

    @property
    def own_places(self) -> tuple[str, ...]:
        """The name of its place on this host, as others know it."""
        return () if self._path is None else (self._path.name,)

    def listen_on_host(self) -> None:
        """Listens for this user on this host, too. Idempotent; logs a problem."""
        with self._guard:
            self._listens_on_host = True
            if self._path is None and not self._closed:
                self._open_on_host()

    def _open_on_host(self) -> None:
        try:
            server = host_socket(self._system)
        except (OSError, TradeError) as bad:
            if not self._warned:
                _logger.warning("the stop line on this host cannot be opened: %s. Stops here need the transport", bad)
            self._warned = True
            return
        self._warned = False
        if server is not None:
            sock, self._path = server
            self._on_host = Listener([(sock, None)], self._serve)
            self._listeners.append(self._on_host)

    def keep_place(self) -> None:
        """Listens on this host again if no client can reach it there, as when the folder was emptied. Called often."""
        with self._guard:
            if self._closed or not self._listens_on_host or (self._path is not None and not is_deaf(self._path)):
                return
            if self._path is not None:
                _logger.warning("%s, the stop line on this host, has vanished, and is made again", self._path)
            before, self._path, self._on_host = self._on_host, None, None
            self._listeners = [one for one in self._listeners if one is not before]
            self._open_on_host()
        if before is not None:
            before.close()

    # --- called by the listener

    def _serve(self, sock: socket.socket, certified: str, line: bytes) -> None:
        try:
            request = read_request(line)
        except Malformed as bad:
            self._end(sock, StopAnswer(who=self._own.who, error="Malformed", why=str(bad)))
            return
        identity = certified or request.by.partition("/")[0] or self._own.identity
        with self._guard:
            full = self._busy[identity] >= MOST_OF_ONE or self._busy.total() >= MOST
            if not full:
                self._busy[identity] += 1
        if full:
            reason = (
                f"{MOST_OF_ONE} requests of {identity}, or {MOST} in all, are in progress; ask again when one is over"
            )
            self._end(sock, StopAnswer(who=self._own.who, error=LimitExceeded.__name__, why=reason))
            return
        work = (sock, identity, request)
        threading.Thread(target=self._work, args=work, name="trade-stop-work", daemon=True).start()

    def _work(self, sock: socket.socket, identity: str, request: StopRequest) -> None:
        try:
            answer = self._answer(sock, identity, request)
        except TradeError as error:
            answer = StopAnswer(who=self._own.who, error=type(error).__name__, why=str(error))
        except Exception as error:
            _logger.exception("a request on the stop line failed")
            answer = StopAnswer(who=self._own.who, error=type(error).__name__, why=str(error))
        finally:
            with self._guard:
                self._busy[identity] -= 1
                self._busy += Counter()  # forget identities without requests
        self._end(sock, answer)

    def _answer(self, sock: socket.socket, identity: str, request: StopRequest) -> StopAnswer:
        own, requester = self._own.who, f"{identity}/{request.by.partition('/')[2]}".rstrip("/")
        denied = self._access.denied_order(identity, clears=False)
        if denied is not None:
            self._audit.refused(f"trade.{request.ask}", denied, who=identity)
            raise denied
        if request.ask == "open":
            return StopAnswer(who=own, open=tuple(estop_fields(estop) for estop in self._estop.estops()))
        self._send(sock, StopAnswer(who=own, taken=True))
        if request.ask == "stop":
            self._audit.note("stop", "stop line", about=request.group, who=identity, why=request.reason)
            _logger.warning("stopping %s, asked by %s on the stop line: %s", request.group, requester, request.reason)
            return StopAnswer(who=own, stop=self._stop(identity, request.group, request.limit_s))
        if not self._estop.knows(request.id):  # else it was received, and is on record
            self._audit.note("stop", "stop line", about=request.id, who=identity, why=request.reason)
        reason = f"{request.reason} (asked by {requester} on the stop line)".lstrip()
        return StopAnswer(who=own, estop=self._estop.relay(request.id, reason, request.limit_s, beyond=request.pass_on))

    def _send(self, sock: socket.socket, answer: StopAnswer) -> None:
        with contextlib.suppress(OSError):  # the client need not wait for the answer
            sock.settimeout(_ANSWER_S)
            sock.sendall(encoded(answer))

    def _end(self, sock: socket.socket, answer: StopAnswer) -> None:
        self._send(sock, answer)
        sock.close()

    def close(self) -> None:
        """Stops listening. Idempotent."""
        with self._guard:
            self._closed = True
            listeners, self._listeners = self._listeners, []
        for listener in listeners:
            listener.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def _network_sockets(settings: Settings, certificate: Certificate) -> list[tuple[socket.socket, ssl.SSLContext | None]]:
    """One listening socket beside each endpoint with a fixed port."""
    context = line_context(certificate, server=True)
    servers: list[tuple[socket.socket, ssl.SSLContext | None]] = []
    try:
        for endpoint in filter(_is_known, map(Endpoint.read, settings.listen)):
            servers.append((network_socket(endpoint), context))  # noqa: PERF401 - the open ones are closed if one fails
    except BaseException:
        for server, _ in servers:
            server.close()
        raise
    return servers


def _is_known(endpoint: Endpoint) -> bool:
    return bool(endpoint.port)
