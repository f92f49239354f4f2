"""One HTTP/1.0 request with a total timeout; `http.client` limits each wait, but not their sum."""

import socket
import time
from typing import Final, NamedTuple
from urllib.parse import urlsplit

_MOST_BYTES: Final = 32 * 2**20
_CHUNK: Final = 65_536
_END: Final = b"\r\n\r\n"


class Place(NamedTuple):
    """The address of a picture."""

    host: str
    port: int
    target: str


class Answer(NamedTuple):
    """The answer of a server."""

    status: int
    reason: str
    body: bytes


def place_of(url: str) -> Place:
    """Returns the parts of a URL; raises ValueError for an unsupported one."""
    parts = urlsplit(url)
    if parts.scheme != "http" or not parts.hostname or parts.username:
        raise ValueError(f"{url!r} is not like http://192.168.0.20/snapshot.jpg (no https, no user)")
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    if any(not "!" <= letter <= "~" for letter in target):
        raise ValueError(f"{url!r} has letters in it that must be written as %20 and the like")
    return Place(parts.hostname, parts.port or 80, target)


def ask(place: Place, within_s: float) -> Answer:
    """Sends a GET request and returns the answer.

    Raises:
        OSError: the server does not answer, or not completely in time.
        ValueError: the answer is not HTTP, or too large.
    """
    deadline = time.monotonic() + within_s
    with socket.create_connection((place.host, place.port), within_s) as link:
        link.sendall(f"GET {place.target} HTTP/1.0\r\nHost: {place.host}\r\n\r\n".encode("ascii"))
        got = bytearray()
        while len(got) <= _MOST_BYTES:
            if (answer := parse_answer(bytes(got))) is not None:
                return answer
            if (left_s := deadline - time.monotonic()) <= 0:
                raise TimeoutError("its answer takes too long")
            link.settimeout(left_s)
            if not (data := link.recv(_CHUNK)):
                return _ended(bytes(got))
            got += data
    raise ValueError(f"its answer has more than {_MOST_BYTES} bytes")


def parse_answer(got: bytes) -> Answer | None:
    """Returns the answer if it states its length and is complete.

    Raises:
        ValueError: the answer is not HTTP.
    """
    head, end, body = got.partition(_END)
    if not end:
        return None
    length = _length(head)
    return None if length is None or len(body) < length else _answer(head, body[:length])


def _ended(got: bytes) -> Answer:
    """Returns an answer that the end of the connection completes, as it does not state its length."""
    head, end, body = got.partition(_END)
    if not end or _length(head) is not None:
        raise ConnectionResetError("it hung up in the middle of its answer")
    return _answer(head, body)


def _length(head: bytes) -> int | None:
    for line in head.split(b"\r\n")[1:]:
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length":
            return int(value)
    return None


def _answer(head: bytes, body: bytes) -> Answer:
    version, _, rest = head.split(b"\r\n")[0].decode("latin-1").partition(" ")
    status, _, reason = rest.partition(" ")
    if not version.startswith("HTTP/") or not status.isdecimal():
        raise ValueError(f"no HTTP: it begins with {head[:16]!r}")
    return Answer(int(status), reason, body)
