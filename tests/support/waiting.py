"""Waiting for what other threads and processes do."""

import threading
import time
from collections.abc import Callable

from trade import Container

PATIENCE_S = 60.0
_LEAST_S = 0.002


def wait_until(true: Callable[[], object], what: str = "it happened") -> None:
    """Look at a condition until it holds; the only deadline is one no healthy run comes near.

    Looking takes a fifth of the time at most: who is waited for may need the core.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        looked_at = time.monotonic()
        if true():
            return
        now = time.monotonic()
        assert now < deadline, f"waited {PATIENCE_S} s in vain until {what}"
        threading.Event().wait(max(_LEAST_S, 4 * (now - looked_at)))


def wait_until_dialled(container: Container) -> None:
    """Wait until the container dials no endpoint any more, and has warned of those that refuse it."""
    dialer = container.reach
    wait_until(lambda: not (dialer._has_work() or dialer._rounds._running), "it dials no more")
