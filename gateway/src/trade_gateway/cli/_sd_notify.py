"""Telling systemd how this process fares: datagrams to the socket that it names; without one nothing is told.

After sd_notify(3). Only the process that was started is listened to: the variables are taken out of the environment, so
that no child speaks for it.
"""

import contextlib
import os
import socket
import time
from collections.abc import MutableMapping
from types import TracebackType
from typing import Final

__all__ = ["Notifier"]

_PATIENCE_S: Final = 1.0
"""How long a message may wait for its reader."""


class Notifier:
    """The socket of whoever started this process and wants to know.

    Args:
        environment: of the process; ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are taken out of it.
    """

    def __init__(self, environment: MutableMapping[str, str] = os.environ) -> None:
        address = environment.pop("NOTIFY_SOCKET", "")
        asked, whom = environment.pop("WATCHDOG_USEC", ""), environment.pop("WATCHDOG_PID", "")
        self._watched = asked.isdigit() and int(asked) > 0 and whom in ("", str(os.getpid()))
        self._socket = _connected(address)

    def ready(self, status: str) -> None:
        """It is up, or has read its configuration again."""
        self._tell("READY=1", f"STATUS={status}")

    def reloading(self) -> None:
        """It reads its configuration again, and `ready` will follow."""
        self._tell("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def alive(self) -> None:
        """To be told by what would not come by if the process hung."""
        if self._watched:
            self._tell("WATCHDOG=1")

    def leaving(self) -> None:
        """It leaves; how long that may take is up to the unit."""
        self._tell("STOPPING=1", "STATUS=leaving")

    def close(self) -> None:
        """Tell nothing any more. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> "Notifier":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _tell(self, *lines: str) -> None:
        if self._socket is not None:
            text = "\n".join(line.replace("\n", " ") for line in lines)
            with contextlib.suppress(OSError):  # nobody listens any more: that is nothing to end for
                self._socket.send(text.encode())


def _connected(address: str) -> socket.socket | None:
    if address[:1] not in ("/", "@"):  # nobody asks, or by a kind of socket that there is not here
        return None
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    opened.settimeout(_PATIENCE_S)
    try:
        opened.connect(f"\0{address[1:]}" if address.startswith("@") else address)
    except OSError:
        opened.close()
        return None
    return opened
