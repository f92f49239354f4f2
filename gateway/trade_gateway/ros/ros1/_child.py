"""Supervises the ROS 1 node in a child process: starts it, reads its frames, and restarts it when it ends."""

import logging
import os
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, Final
from urllib.parse import urlparse

from trade_gateway.ros.ros1._node._frames import Channel, Head

_log: Final = logging.getLogger("trade.ros1")
_HERE: Final = str(Path(__file__).parent)
_START: Final = "import runpy, sys; sys.path.append(sys.argv.pop(1)); runpy.run_module('_node', run_name='__main__')"
_SILENT_S: Final = 3.0
"""Timeout of its sign of life, which it sends twice a second; a silent child is killed."""
_START_S: Final = 15.0
"""Timeout of its first sign of life."""
_END_S: Final = 4.0
"""Time for unregistering."""
_FIRST_PAUSE_S: Final = 0.2
_LAST_PAUSE_S: Final = 5.0
_STEADY_S: Final = 10.0
"""A child that lived this long is restarted at once."""


class Child:
    """The child process.

    `on_start` gets the channel of each new one, `on_end` reports its end, and `on_frame` gets its frames.
    """

    def __init__(
        self,
        *,
        master: str,
        node: str,
        python: str,
        ip: str,
        on_start: Callable[[Channel], object],
        on_end: Callable[[], object],
        on_frame: Callable[[Head, bytes], object],
    ) -> None:
        self._command = [python, "-B", "-c", _START, _HERE]
        self._arguments = [master, node]
        self._environment = environment(master, ip)
        self._callbacks = on_start, on_end, on_frame
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._channel: Channel | None = None
        self._words: deque[str] = deque(maxlen=1)
        self.problem = "the node of ROS 1 is starting"
        self._thread = threading.Thread(target=self._run, name="trade-ros1", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the child and waits until it has unregistered. Idempotent."""
        self._closed.set()
        with self._lock:
            if self._channel is not None:
                self._channel.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_END_S + 2)

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._closed.is_set():
            began = time.monotonic()
            self._words.clear()
            problem = self._live()
            detail = f": {self._words[-1]}" if self._words else ""
            before, self.problem = self.problem, f"the node of ROS 1 {problem}{detail}"
            if self._closed.is_set():
                return
            if self.problem != before:
                _log.warning("%s; it is started again", self.problem)
            steady = time.monotonic() - began > _STEADY_S
            pause_s = _FIRST_PAUSE_S if steady else min(2 * pause_s, _LAST_PAUSE_S)
            self._closed.wait(pause_s)

    def _live(self) -> str:
        """Runs one child process; returns how it ended."""
        came, gone, heard = self._callbacks
        own_end, child_end = socket.socketpair()
        with own_end:
            try:
                with child_end:
                    process = self._start(child_end)
            except OSError as error:
                return f"cannot be started: {error}"
            words = threading.Thread(target=self._listen, args=(process.stderr,), name="trade-ros1-words", daemon=True)
            words.start()
            own_end.settimeout(_START_S)
            channel = Channel(own_end, "trade-ros1")
            signs = _SignsOfLife(own_end, heard)
            stood_still = ""
            with self._lock:
                self._channel = channel
            try:
                if not self._closed.is_set():
                    came(channel)
                    channel.read(signs.heard)
                    stood_still = signs.missing
            finally:
                channel.close()
                with self._lock:
                    self._channel = None
                if stood_still and not self._closed.is_set():
                    _log.warning("the node of ROS 1 %s; it is ended", stood_still)
                    self.problem = f"the node of ROS 1 {stood_still}"
                    process.kill()
                gone()
                code = _ended(process)
                words.join(_END_S)
        return stood_still or f"has ended ({code})"

    def _start(self, child_end: socket.socket) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(  # noqa: S603 - the configured Python, and our own program
            [*self._command, str(child_end.fileno()), *self._arguments],
            env=self._environment,
            pass_fds=[child_end.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    def _listen(self, words: IO[bytes]) -> None:
        with words:
            for line in words:
                if text := line.decode(errors="replace").strip():
                    self._words.append(text)
                    _log.info("node of ROS 1: %s", text)


class _SignsOfLife:
    """The signs of life among the frames."""

    def __init__(self, sock: socket.socket, on_frame: Callable[[Head, bytes], object]) -> None:
        self._sock = sock
        self._on_frame = on_frame
        self._patience_s = _START_S
        self._last_at_s = time.monotonic()

    def heard(self, head: Head, body: bytes) -> None:
        if head["op"] == "alive":
            self._patience_s = _SILENT_S
            self._sock.settimeout(_SILENT_S)
        else:
            self._on_frame(head, body)
        self._last_at_s = time.monotonic()

    @property
    def missing(self) -> str:
        """Empty, or for how long there was no sign of life."""
        late = time.monotonic() - self._last_at_s >= self._patience_s
        return f"froze: it sent nothing for {self._patience_s:g} s" if late else ""


def environment(master: str, ip: str) -> dict[str, str]:
    """Returns the child's environment. With a local master the node listens on loopback by default."""
    made = {name: value for name, value in os.environ.items() if name != "PYTHONHOME"}
    made["ROS_MASTER_URI"] = master
    named = [name for name in ("ROS_IP", "ROS_HOSTNAME") if made.get(name)]
    host = urlparse(master).hostname or ""
    if ip or (not named and (host == "localhost" or host.startswith("127."))):
        for name in named:
            del made[name]
        made["ROS_IP"] = ip or "127.0.0.1"
    return made


def _ended(process: "subprocess.Popen[bytes]") -> int:
    try:
        return process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait(_END_S)
