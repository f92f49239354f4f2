"""What ends a command together with the one that started it: standard input, which that one holds open."""

import os
import signal
import sys
import threading
from typing import Final

_LEAVE_S: Final = 15.0
"""How long it may take to leave in order; a robot is brought to rest first."""


def end_with_stdin() -> None:
    """From now on the end of standard input is as SIGTERM is; who does not leave then is ended."""
    threading.Thread(target=_watch, name="trade-lifeline", daemon=True).start()


def _watch() -> None:
    try:
        while os.read(sys.stdin.fileno(), 4096):
            pass
    except OSError:  # it is as gone as can be
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_LEAVE_S)
    os._exit(1)
