"""How two containers of one host prove to each other who they are, once for each connection."""

import hmac
import os
import socket
import struct
from collections.abc import Callable
from typing import Final

import msgspec
from msgspec import Struct, structs

from trade._security.certificates import Certificate, common_name, line_context
from trade.protocol.keys import Address, is_chunk
from trade.protocol.messages import PROTOCOL, Malformed, OtherVersion, encode_message, read_any
from trade.transport.host_socket import is_own_user
from trade.transport.local_connection import ConnectionEnded, LocalConnection
from trade.transport.shared_segment import SharedSegment

_ANSWER_S: Final = 1.0
_INTERRUPT_S: Final = 0.5
"""How often a caller that waits returns to the interpreter. A Ctrl-C that came just before it waited ends it then."""
_MOST_GREETING_BYTES: Final = 4096
_MOST_DESCRIPTORS: Final = 2
"""One more than a greeting may have."""
_CLOSE_ON_EXEC: Final[int] = getattr(socket, "MSG_CMSG_CLOEXEC", 0)
"""Exists on Linux only."""
_TIMEVAL: Final = "ll"
"""Seconds and microseconds."""


class Greeting(Struct, frozen=True, array_like=True, gc=False):
    """The first message of a connection."""

    v: int
    caller: Address
    reply: str
    """``container/channel`` of the caller's reply key."""
    stops: bool
    """Whether it is for stops, which get through when there are too many other connections."""
    proof: bytes
    """Of the credentials; empty if a certificate proves the identity."""
    shared: bool = False
    """Whether it carries many calls at a time, whose answers come in any order."""
    segment_bytes: int = 0
    """The size of the shared segment whose descriptor comes with it; 0 for none."""


_decoder: Final = msgspec.msgpack.Decoder(Greeting)


class Passport:
    """What a container has to prove its identity with: its certificate, or the system's credentials.

    Args:
        own: the container.
        certificate: reads its current certificate; None if it has none.
        password: the system's; unused with a certificate.
    """

    def __init__(self, own: Address, certificate: Callable[[], Certificate | None], password: str) -> None:
        self.own = own
        self._certificate = certificate
        self._password = password.encode()

    def greet(
        self,
        sock: socket.socket,
        callee: Address,
        reply: str,
        *,
        stops: bool,
        shared: bool,
        limit_s: float,
        large: bool = False,
    ) -> LocalConnection:
        """Opens the caller's end of a connection; takes over the socket, which it closes if that fails.

        With ``large`` it offers a shared segment for large payloads.

        Raises:
            OSError: the other end is not that container, or does not answer in time.
        """
        try:
            if not is_own_user(sock):
                raise PermissionError("another user listens there")
            sock.settimeout(limit_s)
            certificate = self._certificate()
            if certificate is not None:
                sock, identity = _certified(sock, certificate, server=False)
                if identity != callee.identity:
                    raise PermissionError(f"{identity or 'a stranger'} listens there, not {callee.identity}")
            sock.settimeout(None)
            proof = b"" if certificate is not None else self._proof(self.own, callee)
            connection = LocalConnection(sock)
            _send(connection, Greeting(PROTOCOL, self.own, reply, stops, proof, shared), large=large)
            if shared:
                _limit(sock, socket.SO_SNDTIMEO, _ANSWER_S)  # others want to send, too
            else:
                _limit(sock, socket.SO_RCVTIMEO, _INTERRUPT_S)
        except ConnectionEnded:
            sock.close()
            raise ConnectionResetError from None
        except BaseException:
            sock.close()
            raise
        return connection

    def welcome(self, sock: socket.socket) -> tuple[LocalConnection, Greeting]:
        """Opens the callee's end of a connection; takes over the socket, which it closes if that fails.

        Raises:
            OSError: the caller does not greet in time, or its certificate is not accepted.
            Malformed: what it sends is no greeting, or proves nothing.
        """
        descriptors: list[int] = []
        try:
            if not is_own_user(sock):
                raise PermissionError("the connection is of another user")
            sock.settimeout(_ANSWER_S)
            certificate, identity = self._certificate(), ""
            if certificate is not None:
                sock, identity = _certified(sock, certificate, server=True)
                sock.settimeout(_ANSWER_S)
            received, descriptors = _receive(sock)
            connection = LocalConnection(sock, received)
            _, payload = connection.receive(_MOST_GREETING_BYTES)
            greeting = read_any(_decoder, payload)
            self._check(greeting, identity, certified=certificate is not None)
            segment = SharedSegment.taken(descriptors, greeting.segment_bytes)
            if segment is not None:
                connection.take(segment)
            sock.settimeout(None)
            _limit(sock, socket.SO_SNDTIMEO, _ANSWER_S)
        except ConnectionEnded:
            sock.close()
            raise ConnectionResetError from None
        except BaseException:
            sock.close()
            raise
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        return connection, greeting

    def _check(self, greeting: Greeting, identity: str, *, certified: bool) -> None:
        if greeting.v != PROTOCOL:
            raise OtherVersion(greeting.v)
        caller = greeting.caller
        if not (is_chunk(caller.identity) and is_chunk(caller.container) and is_chunk(caller.epoch)):
            raise Malformed(f"{caller} is not the address of a container")
        if certified and identity != caller.identity:
            raise Malformed(f"the certificate is of {identity or 'no identity'}, not of {caller.identity}")
        if not certified and not hmac.compare_digest(greeting.proof, self._proof(caller, self.own)):
            raise Malformed(f"{caller.who} has other credentials")
        if not greeting.reply.startswith(f"{caller.container}/"):
            raise Malformed(f"{greeting.reply!r} is no reply key of {caller.who}")

    def _proof(self, caller: Address, callee: Address) -> bytes:
        return hmac.digest(self._password, f"{caller} calls {callee}".encode(), "sha256")


def _certified(sock: socket.socket, certificate: Certificate, *, server: bool) -> tuple[socket.socket, str]:
    """Exchanges certificates; returns the plain socket, for what is said afterwards, and the other end's identity.

    What passes between processes of one user on one host needs no encryption: the operating system protects it.
    """
    context = line_context(certificate, server=server)
    if server:
        context.num_tickets = 0  # nothing may follow the handshake but its end
    else:
        context.check_hostname = False  # the caller compares identities
    secure = context.wrap_socket(sock, server_side=server)
    try:
        identity = common_name(secure)
        secure.unwrap()
        return socket.socket(fileno=secure.detach()), identity
    except BaseException:
        secure.close()
        raise


def _send(connection: LocalConnection, greeting: Greeting, *, large: bool) -> None:
    made = SharedSegment.make() if large else None
    if made is None:
        connection.send(encode_message(greeting))
        return
    segment, descriptor = made
    try:
        greeting = structs.replace(greeting, segment_bytes=segment.size_bytes)
        connection.offer(encode_message(greeting), segment, descriptor)
    finally:
        os.close(descriptor)


def _receive(sock: socket.socket) -> tuple[bytes, list[int]]:
    """The first bytes of a connection, and the descriptors with them."""
    received, descriptors, _, _ = socket.recv_fds(sock, _MOST_GREETING_BYTES, _MOST_DESCRIPTORS, _CLOSE_ON_EXEC)
    return received, descriptors


def _limit(sock: socket.socket, option: int, limit_s: float) -> None:
    """Limits how long a message waits for an end that does not read, or the receiving thread for a message."""
    seconds, rest_s = divmod(limit_s, 1)
    sock.setsockopt(socket.SOL_SOCKET, option, struct.pack(_TIMEVAL, int(seconds), int(rest_s * 1e6)))
