"""The text that socketcand and its clients exchange in raw mode. Pure: bytes in, values out, and back."""

import re
from typing import Final

from trade_hil_sim.faults._commands import SimulationError

from ._frame import Frame

GREETING: Final = b"< hi >"
OK: Final = b"< ok >"
LONGEST: Final = 256
"""The greatest length of a command; longer ones are discarded."""
COMMAND: Final = re.compile(rb"<([^<>]*)>")
ERROR_FLAG: Final = 0x20000000
STANDARD_DIGITS: Final = 3
MOST_DATA: Final = 8


class Reader:
    """Cuts a stream into commands, whatever the segments it comes in."""

    def __init__(self) -> None:
        self._held = b""

    def feed(self, data: bytes) -> list[list[str]]:
        """The commands that are now complete, each as its words; text between commands is ignored."""
        self._held += data
        commands, end = list[list[str]](), 0
        for match in COMMAND.finditer(self._held):
            commands.append(match.group(1).decode("ascii", "replace").split())
            end = match.end()
        self._held = self._held[end:][-LONGEST:]
        return commands


def parse_send(words: list[str]) -> Frame:
    """The frame a client wants sent: ``123 2 ff a``.

    Three digits make a standard id, more an extended one. A length without data is a remote frame: the clients have no
    other way to say it.

    Raises:
        SimulationError: it is no frame.
    """
    try:
        text, length, *rest = words
        can_id, wanted = int(text, 16), int(length, 16)
        data = bytes(int(byte, 16) for byte in rest)
    except ValueError:
        raise SimulationError(f"not a frame: {' '.join(words)}") from None
    extended = len(text) > STANDARD_DIGITS
    if can_id >> (29 if extended else 11) or wanted > MOST_DATA or len(data) not in {0, wanted}:
        raise SimulationError(f"not a frame: {' '.join(words)}")
    remote = wanted > 0 and not data
    return Frame(can_id, data, extended, remote, wanted if remote else 0)


def frame_text(frame: Frame, wall_s: float) -> bytes:
    """The text for a frame at `wall_s` seconds since the epoch; remote frames have none."""
    if frame.remote:
        return b""
    name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    return f"< frame {name} {wall_s:.6f} {frame.data.hex().upper()} >".encode()


def error_text(bits: int, wall_s: float) -> bytes:
    """The text for an error on the bus: the classes of linux/can/error.h."""
    return f"< error {ERROR_FLAG | bits:08X} {wall_s:.6f} >".encode()


def refusal(reason: str) -> bytes:
    """The text that refuses a client's request."""
    return f"< error {reason} >".encode()
