"""Saves the ring buffer to a folder when a fault occurs."""

import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

import msgspec

from trade.errors import ConfigurationError
from trade_gateway.recording._channels import FAULTS, Fault, Message
from trade_gateway.recording._file import Attachment
from trade_gateway.recording._recorder import Ring

_MS_NS: Final = 1_000_000
HOLD_OFF_S: Final = 10.0
"""A fault within this time after a saved one belongs to the same event, in seconds."""
_decode: Final = msgspec.json.Decoder(Fault).decode

Saved = Callable[[Path, str, int], None]
"""Receives a saved file: its path, the reason and its number of messages."""


class SavedAtFault:
    """A sink that keeps the last seconds, and saves them once for each event. Used by one thread."""

    def __init__(
        self,
        folder: Path,
        ring: Ring,
        about: Mapping[str, str],
        attachments: Sequence[Attachment],
        saved: Saved,
        failed: Callable[[str], None],
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Creates the sink.

        Args:
            folder: created if necessary.
            ring: the ring buffer.
            about: metadata of each file.
            attachments: of each file.
            saved: called after each file.
            failed: called with the reason if a file cannot be written; recording continues until the next event.
            clock: a monotonic clock in seconds.

        Raises:
            ConfigurationError: the folder cannot be created.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as bad:
            raise ConfigurationError(where=str(folder), problem=f"cannot be created: {bad.strerror}") from None
        self._folder = folder
        self._ring = ring
        self._about = about
        self._attachments = attachments
        self._saved = saved
        self._failed = failed
        self._clock = clock or time.monotonic
        self._held_until = 0.0

    def write(self, message: Message) -> None:
        """Adds a message; saves everything if it reports a fault."""
        self._ring.write(message)
        if message.channel is FAULTS:
            fault = _decode(message.data)
            if fault.kind != "gone" and fault.text and fault.new:
                self._save(fault)

    def _save(self, fault: Fault) -> None:
        now, at_ns = self._clock(), time.time_ns()  # a clock that was wrong when the recorder began may be right now
        if now < self._held_until:
            return
        self._held_until = now + HOLD_OFF_S
        name = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in fault.about)
        while (path := self._folder / f"{_stamp(at_ns)}-{name}.mcap").exists():  # the clock was set back
            at_ns += _MS_NS
        why = f"{fault.about}: {fault.text}"
        try:
            count = self._ring.save(path, {**self._about, "fault": why}, self._attachments)
        except (OSError, ConfigurationError) as bad:
            self._failed(f"{path} is incomplete: {bad}")
        else:
            self._saved(path, why, count)


def _stamp(at_ns: int) -> str:
    at = datetime.fromtimestamp(at_ns / 1e9, timezone.utc)
    return f"{at:%Y%m%dT%H%M%S}.{at_ns // _MS_NS % 1000:03d}Z"
