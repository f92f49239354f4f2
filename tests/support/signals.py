"""Signals to one thread of another process."""

import ctypes
from pathlib import Path

__all__ = ["signal_another_thread"]


def signal_another_thread(pid: int, number: int) -> None:
    """Sends a signal to a thread that is not the main one (tgkill(2)).

    It wakes no wait of the main thread, as one does not that arrives just before the wait.
    """
    thread = max(int(task.name) for task in Path(f"/proc/{pid}/task").iterdir())
    assert thread != pid, "it has no other thread"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.tgkill(pid, thread, number):
        raise OSError(ctypes.get_errno(), f"tgkill({pid}, {thread}, {number})")
