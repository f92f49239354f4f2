"""Frames between TRADE and its ROS 1 node: a JSON head and raw bytes. Both Pythons run this, so it needs Python 3.8."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import struct
import threading
from collections import deque
from typing import Any, Callable, Dict

Head = Dict[str, Any]
Heard = Callable[[Head, bytes], object]
"""Receives a frame."""

_LENGTHS = struct.Struct("<II")
_LARGEST = 256 << 20
"""Greatest size of a frame's body in bytes; a greater one means a corrupt stream."""
_log = logging.getLogger("trade.ros1")


class Channel:
    """One end of a stream socket. `put` never waits, as a thread writes; of droppable frames the newest are kept."""

    def __init__(self, sock: socket.socket, name: str) -> None:
        self._sock = sock
        self._ready = threading.Condition()
        self._order: deque[str] = deque()
        self._waiting: dict[str, deque[tuple[Head, bytes]]] = {}
        self._closed = False
        threading.Thread(target=self._write, name=name + "-writer", daemon=True).start()

    def put(self, head: Head, body: bytes = b"", *, key: str = "", most: int = 0) -> None:
        """Queues a frame. At most `most` frames with this key wait (0: any number). After the end it does nothing."""
        if len(body) > _LARGEST:
            _log.error("a message of %s bytes was dropped: %s", len(body), head)
            return
        with self._ready:
            if self._closed:
                return
            waiting = self._waiting.setdefault(key, deque())
            if most and len(waiting) >= most:
                waiting.popleft()
            else:
                self._order.append(key)
            waiting.append((head, body))
            self._ready.notify()

    def read(self, heard: Heard) -> None:
        """Reads until either end closes or the socket's timeout passes."""
        try:
            while True:
                head_size, body_size = _LENGTHS.unpack(self._exactly(_LENGTHS.size))
                if max(head_size, body_size) > _LARGEST:
                    _log.error("a frame of %s bytes: not from the other end's program", max(head_size, body_size))
                    return
                head = json.loads(self._exactly(head_size))
                heard(head, self._exactly(body_size))
        except (EOFError, OSError):
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Idempotent."""
        with self._ready:
            if self._closed:
                return
            self._closed = True
            self._ready.notify_all()
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_RDWR)

    def _write(self) -> None:
        try:
            while True:
                frame = self._take()
                if frame is None:
                    return
                head = json.dumps(frame[0], default=str).encode()
                self._sock.sendall(_LENGTHS.pack(len(head), len(frame[1])) + head)
                self._sock.sendall(frame[1])
        except OSError:
            pass
        finally:
            self.close()

    def _take(self) -> tuple[Head, bytes] | None:
        with self._ready:
            while not self._order and not self._closed:
                self._ready.wait()
            if self._closed:
                return None
            key = self._order.popleft()
            waiting = self._waiting[key]
            frame = waiting.popleft()
            if not waiting:
                del self._waiting[key]
            return frame

    def _exactly(self, size: int) -> bytes:
        read = bytearray(size)
        rest = memoryview(read)
        while rest:
            count = self._sock.recv_into(rest)
            if not count:
                raise EOFError
            rest = rest[count:]
        return bytes(read)
