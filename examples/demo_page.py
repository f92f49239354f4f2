"""The dashboard of `--stay`: an HTTP gateway on the laboratory's network, forwarded to this host's browser."""

import contextlib
import socket
import threading
from collections.abc import Generator
from urllib.parse import urlsplit

from demo_stage import Stage

from trade_gateway.http import add_token

_CHUNK = 65536


@contextlib.contextmanager
def http_gateway(scene: Stage) -> Generator[tuple[str, str]]:
    """An address on the laboratory's network, and a token for anna."""
    tokens = scene.folder / "http-tokens.toml"
    token = add_token(tokens, "anna")
    words = ("http", "--name", "page", "--listen", "127.0.0.1:0", "--tokens", tokens, "--json")
    with scene.trade("anna", *words) as opened:
        yield opened.ready()["url"], token


@contextlib.contextmanager
def dashboard(scene: Stage) -> Generator[tuple[str, str]]:
    """An address for the browser of this host, and a token for anna."""
    with http_gateway(scene) as (url, token):
        if (window := scene.places.window) is None:
            yield url, token
            return
        threading.Thread(target=_let_through, args=(window, urlsplit(url).port), daemon=True).start()
        yield f"http://127.0.0.1:{window.getsockname()[1]}", token


def _let_through(window: socket.socket, port: int) -> None:
    """Forward connections from a port of this host to a port of the laboratory's network."""
    while True:
        try:
            outside, _ = window.accept()
            inside = socket.create_connection(("127.0.0.1", port))
        except OSError:  # the demo has ended
            return
        for one, other in ((outside, inside), (inside, outside)):
            threading.Thread(target=_pump, args=(one, other), daemon=True).start()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            sink.sendall(data)
    with contextlib.suppress(OSError):
        sink.shutdown(socket.SHUT_WR)
