"""Notifies systemd of this process's state: sd_notify(3) datagrams, sent only if systemd named a socket.

The variables are removed from the environment, so that no child process sends notifications in its place.
"""

import contextlib
import os
import socket
import time
from collections.abc import MutableMapping
from types import TracebackType
from typing import Final

_PATIENCE_S: Final = 1.0
"""How long a message may wait for its reader, in seconds."""


class Notifier:
    """The notification socket of the service manager that started this process.

    Args:
        environment: the process's; ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are removed from it.
    """

    def __init__(self, environment: MutableMapping[str, str] = os.environ) -> None:
        address = environment.pop("NOTIFY_SOCKET", "")
        asked, whom = environment.pop("WATCHDOG_USEC", ""), environment.pop("WATCHDOG_PID", "")
        self._watched = asked.isdigit() and int(asked) > 0 and whom in ("", str(os.getpid()))
        self._socket = _connected(address)

    def ready(self, status: str) -> None:
        """Reports that the process is ready, or has reloaded its configuration."""
        self._send("READY=1", f"STATUS={status}")

    def reloading(self) -> None:
        """Reports that the process reloads its configuration; call `ready` afterwards."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def alive(self) -> None:
        """Resets the watchdog. Call it from the loop that would stop if the process hung."""
        if self._watched:
            self._send("WATCHDOG=1")

    def leaving(self) -> None:
        """Reports that the process shuts down; the unit limits how long that may take."""
        self._send("STOPPING=1", "STATUS=leaving")

    def close(self) -> None:
        """Closes the socket. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> "Notifier":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _send(self, *lines: str) -> None:
        if self._socket is not None:
            text = "\n".join(line.replace("\n", " ") for line in lines)
            with contextlib.suppress(OSError):  # without a reader the process continues
                self._socket.send(text.encode())


def _connected(address: str) -> socket.socket | None:
    if address[:1] not in ("/", "@"):  # no socket is named, or one of an unsupported kind
        return None
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    opened.settimeout(_PATIENCE_S)
    try:
        opened.connect(f"\0{address[1:]}" if address.startswith("@") else address)
    except OSError:
        opened.close()
        return None
    return opened
