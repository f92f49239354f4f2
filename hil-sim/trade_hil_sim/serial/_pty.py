"""A pty that acts as a serial port: raw on both sides, with a stable name, and the client's baud rate readable."""

import array
import fcntl
import os
import pty
import termios
import tty
from contextlib import suppress
from pathlib import Path
from typing import Final

TCGETS2: Final = 0x802C542A
"""Linux ioctl that reads baud rates outside the classic list (asm-generic/ioctls.h)."""
SPEED_WORD: Final = 10
"""Where ``struct termios2`` keeps the input speed, counted in 32-bit words."""
CLASSIC: Final = {
    value: int(name[1:]) for name, value in vars(termios).items() if name[:1] == "B" and name[1:].isdigit()
}


class Terminal:
    """One plugged-in serial adapter; `close` unplugs it.

    Both ends stay open here: with the client's end closed, reading would fail whenever no client has it open. The link
    goes when the adapter goes, because the system soon reuses the number of a closed pty.

    Args:
        link: the stable name clients open; replaced atomically.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self.master, self._slave = pty.openpty()
        try:
            # else the line discipline echoes what is sent before a client opens
            tty.setraw(self.master)
            tty.setraw(self._slave)
            os.set_blocking(self.master, False)
            self._point_link()
        except BaseException:
            self._close_ends()
            raise

    def client_baud(self) -> int | None:
        """The baud rate the client has set, or None where the system cannot tell."""
        speed = termios.tcgetattr(self.master)[4]
        if isinstance(speed, int) and speed in CLASSIC:
            return CLASSIC[speed]
        return self._custom_baud()

    def _custom_baud(self) -> int | None:
        words = array.array("I", [0] * 11)
        try:
            fcntl.ioctl(self.master, TCGETS2, words)
        except OSError:
            return None
        return words[SPEED_WORD]

    def _point_link(self) -> None:
        fresh = self.link.with_name(f".{self.link.name}.{os.getpid()}")
        with suppress(FileNotFoundError):
            fresh.unlink()
        fresh.symlink_to(os.ttyname(self._slave))
        fresh.replace(self.link)

    def close(self) -> None:
        """Unplug: remove the link, then close the pty. Call it from the thread that polls `master`."""
        with suppress(FileNotFoundError):
            self.link.unlink()
        self._close_ends()

    def _close_ends(self) -> None:
        os.close(self.master)
        os.close(self._slave)
