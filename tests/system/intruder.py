"""Bare sessions that say what no container would: controlled on standard input like ``member.py``, in its place."""

import json
import os
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import zenoh

from trade._security.certificates import Certificate
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import configuration
from trade.transport.zenoh_links import open_session

_PATIENCE_S = 20.0


class Intruder:
    """Sessions by a name for each, with whatever certificates; none of them has rules of its own."""

    def __init__(self) -> None:
        self._sessions: dict[str, zenoh.Session] = {}
        self._heard: dict[str, Any] = {}
        self._declared: list[Any] = []

    def open(self, name: str, folder: str, endpoint: str, mode: str = "peer") -> None:
        """A session with the certificate of a folder, good or not; dialling begins."""
        certificate = Certificate(Path(folder), name, frozenset(), datetime.now(timezone.utc))
        settings = configuration(
            namespace=f"{os.environ['TRADE_SYSTEM']}-0",
            listen=[free_endpoint().replace("tcp/", "tls/")],
            connect=[endpoint],
            certificate=certificate,
        )
        self._sessions[name] = open_session({**settings, "mode": mode})

    def linked(self, name: str, *others: str) -> bool:
        """Whether the gateway and these let it in, or have by the time that patience ends."""
        return _holds(lambda: self.linked_now(name) and set(others) <= set(map(str, self._info(name).peers_zid())))

    def linked_now(self, name: str) -> bool:
        return bool(self._info(name).routers_zid())

    def _info(self, name: str) -> Any:
        return self._sessions[name].info

    def knock(self, folder: str, host: str, port: str) -> str:
        """What a listener says to a certificate: the alert, or nothing."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(Path(folder, "ca.pem"))
        context.load_cert_chain(Path(folder, "cert.pem"), Path(folder, "key.pem"))
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        with socket.create_connection((host, int(port)), _PATIENCE_S) as raw, context.wrap_socket(raw) as knocking:
            knocking.settimeout(1.0)
            try:
                knocking.recv(1)
            except TimeoutError:  # it waits for the first word of the protocol
                return ""
            except ssl.SSLError as refused:
                return str(refused.reason)
        return "closed"

    def put(self, name: str, key: str, payload: str = "") -> None:
        self._sessions[name].put(
            key, bytes.fromhex(payload), congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )

    def token(self, name: str, key: str) -> None:
        """A sign of life, for as long as the session."""
        self._declared.append(self._sessions[name].liveliness().declare_token(key))

    def answer(self, name: str, pattern: str, *said: str) -> None:
        """Answers to queries: keys and replies, in turn."""

        def reply(query: zenoh.Query) -> None:
            for key, payload in zip(said[::2], said[1::2], strict=True):
                if query.key_expr.intersects(key):
                    query.reply(key, bytes.fromhex(payload))

        self._declared.append(self._sessions[name].declare_queryable(pattern, reply))

    def listen(self, name: str, *patterns: str) -> None:
        fifo = zenoh.handlers.FifoChannel(8192)
        self._heard[name] = [self._sessions[name].declare_subscriber(pattern, fifo) for pattern in patterns]

    def heard(self, name: str, wanted: str = "") -> list[list[str]]:
        """Keys and payloads since it was asked last; once that key is among them, if one is named."""
        found: list[list[str]] = []

        def there() -> bool:
            for one in self._heard[name]:
                for sample in iter(one.handler.try_recv, None):
                    found.append([str(sample.key_expr), sample.payload.to_bytes().hex()])
            return not wanted or any(key == wanted for key, _ in found)

        _holds(there)
        return found

    def close(self, name: str) -> None:
        self._sessions.pop(name).close()

    def leave(self) -> None:
        for name in list(self._sessions):
            self.close(name)


def _holds(true: Callable[[], object]) -> bool:
    until = time.monotonic() + _PATIENCE_S
    while not (held := bool(true())) and time.monotonic() < until:
        threading.Event().wait(0.01)
    return held


def main(host: str) -> None:
    socket.sethostname(host)
    intruder = Intruder()
    for line in sys.stdin:
        verb, *words = line.split()
        action: Callable[..., Any] = getattr(intruder, verb)
        try:
            answer: Any = {"answer": action(*words)}
        except Exception as error:  # noqa: BLE001 - whatever it was is reported to the test
            answer = {"error": f"{type(error).__name__}: {error}"}
        os.write(1, (json.dumps(answer) + "\n").encode())
    intruder.leave()


if __name__ == "__main__":
    main(sys.argv[1])
