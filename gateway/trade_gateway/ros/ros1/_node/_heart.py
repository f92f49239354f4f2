"""The heartbeat of this process. TRADE ends and restarts a process without one."""

from __future__ import annotations

import threading
import time

from ._frames import Channel

_EVERY_S = 0.5
_STUCK_S = 60.0
"""Every request to a master has a deadline; work that takes longer than this will never finish."""


class Heart:
    """Sends heartbeats on its own thread, even while other threads wait, as long as the work makes progress."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._worked_at = time.monotonic()
        self.thread = threading.Thread(target=self._beat, name="heart", daemon=True)
        self.thread.start()

    def worked(self) -> None:
        """Reports progress of the work."""
        self._worked_at = time.monotonic()

    def _beat(self) -> None:
        while time.monotonic() - self._worked_at < _STUCK_S:
            self._channel.put({"op": "alive"}, key="alive", most=1)
            time.sleep(_EVERY_S)
