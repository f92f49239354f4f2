"""Service calls with a deadline each; rospy's own proxy waits without one."""

# pyright: basic, reportMissingImports=false

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Any

import rospy
from rospy.core import parse_rosrpc_uri
from rospy.exceptions import TransportException, TransportInitError
from rospy.impl.tcpros_base import TCPROSTransport, recv_buff
from rospy.impl.tcpros_service import TCPROSServiceClient

from ._master import Refused, Unreachable, ask


class _Client(TCPROSServiceClient):
    def _read_service_error(self, sock: Any, b: Any) -> str:
        """Returns the error as text; rospy would print the bytes."""
        while b.tell() < 5 or b.tell() < 5 + _size(b):
            recv_buff(sock, b, 4096)
        return b.getvalue()[5 : 5 + _size(b)].decode("utf-8", "replace")


def _size(read: Any) -> int:
    return int.from_bytes(read.getvalue()[1:5], "little")


def call(master: str, node: str, name: str, service: Any, body: bytes, timeout_s: float) -> bytes:
    """Returns the bytes of the response.

    Raises:
        Unreachable: no node offers the service, or no answer arrived in time.
        Refused: it failed, or has another type.
    """
    deadline = time.monotonic() + timeout_s
    try:
        uri = ask(master, "lookupService", node, name, timeout_s=timeout_s)
    except Refused:
        raise Unreachable("no node offers it") from None
    client = _Client(name, service)
    transport = TCPROSTransport(client, name)
    timer = threading.Timer(max(deadline - time.monotonic(), 0.0), _cut, (transport,))
    timer.daemon = True
    timer.start()
    try:
        return _exchange(transport, uri, service, body, max(deadline - time.monotonic(), 0.05))
    except rospy.ServiceException as error:
        raise Refused(str(error)) from None
    except (TransportException, OSError) as error:
        if transport.header and "error" in transport.header:
            raise Refused(transport.header["error"]) from None
        late = time.monotonic() >= deadline
        raise Unreachable(f"no answer within {timeout_s:.3g} s" if late else str(error)) from None
    finally:
        timer.cancel()
        transport.close()


def _exchange(transport: Any, uri: str, service: Any, body: bytes, timeout_s: float) -> bytes:
    host, port = parse_rosrpc_uri(uri)
    transport.connect(host, port, uri, timeout=timeout_s)
    request = service._request_class()
    request._buff = body
    transport.send_message(request, 1)
    received = transport.receive_once()
    if not received:
        raise TransportInitError("its connection ended without an answer")
    return received[0]._buff


def _cut(transport: Any) -> None:
    """Wakes the thread that waits on it."""
    sock = transport.socket
    if sock is not None:
        with contextlib.suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)
