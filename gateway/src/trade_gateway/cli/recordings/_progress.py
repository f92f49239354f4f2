"""A recording as the command line makes it: where to, and what is said meanwhile."""

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.markup import escape

from trade.errors import ConfigurationError
from trade_gateway.cli._output import Output, complain
from trade_gateway.recording._fault_trigger import SavedAtFault
from trade_gateway.recording._file import Attachment, RecordingFile
from trade_gateway.recording._recorder import Recorder, Ring, about

__all__ = ["Recorder", "Ring", "about", "kept_for_faults", "to_file"]

_MB: Final = 1_000_000


def to_file(
    path: Path,
    out: Output,
    recorder: Recorder,
    about: Mapping[str, str],
    attachments: Sequence[Attachment],
    seconds: float | None,
) -> None:
    """Record to one file, until it is asked to end.

    Raises:
        ConfigurationError: it cannot be made, or the disk is full; then it is readable so far.
    """
    telling, file = _Telling(out), RecordingFile(path, about, attachments)

    def beat() -> None:
        file.flush()
        telling.beat(recorder, file.size_bytes)

    try:
        with file:
            telling.begin(recorder, file.path)
            recorder.run(file, seconds, beat)
    except OSError as bad:
        problem = f"{bad.strerror}; the file ends here and is readable, with {file.size_bytes / _MB:.1f} MB"
        raise ConfigurationError(where=str(file.path), problem=problem) from None
    telling.end(recorder, file.path, file.size_bytes)


def kept_for_faults(
    folder: Path,
    ring: Ring,
    out: Output,
    recorder: Recorder,
    about: Mapping[str, str],
    attachments: Sequence[Attachment],
    seconds: float | None,
) -> None:
    """Keep the last seconds until it is asked to end, and save them at each fault.

    Raises:
        ConfigurationError: there can be no such folder.
    """
    telling = _Telling(out)
    sink = SavedAtFault(folder, ring, about, attachments, telling.saved, complain)
    telling.begin(recorder, folder)
    recorder.run(sink, seconds, lambda: telling.beat(recorder, ring.size_bytes))
    telling.end(recorder, folder, ring.size_bytes)
    if ring.cut_short:
        complain(f"{ring.cut_short} messages had to go before their time; --most-mb gives them more room")


class _Telling:
    """What is said while one records."""

    def __init__(self, out: Output) -> None:
        self._out = out
        self._began = time.monotonic()
        self._live = sys.stdout.isatty() and not out.as_json

    def begin(self, recorder: Recorder, where: Path) -> None:
        """What is recorded, and where to."""
        services = recorder.look()
        if self._out.as_json:
            self._out.data({"recording": str(where), "services": services})
            return
        named = ", ".join(services) or "nothing yet that has joints or pictures"
        self._out.say(f"[bold]recording[/] to {escape(str(where))}: {escape(named)}; Ctrl-C ends")

    def beat(self, recorder: Recorder, size_bytes: int) -> None:
        """How far it is: a line that is written over in a terminal, one a second for programs."""
        if self._out.as_json:
            self._out.data(self._sums(recorder, size_bytes))
        elif self._live:
            print(f"\r{self._text(recorder, size_bytes)} ", end="", flush=True)  # noqa: T201 - Console ends lines

    def saved(self, path: Path, why: str, messages: int) -> None:
        """A file of the last seconds was written."""
        if self._out.as_json:
            self._out.data({"saved": str(path), "why": why, "messages": messages})
        else:
            self._out.say(f"[bold red]{escape(why)}[/]: saved {messages} messages to {escape(str(path))}")

    def end(self, recorder: Recorder, where: Path, size_bytes: int) -> None:
        """What there is now, and what there is not."""
        if recorder.refused:
            complain(f"not all was recorded: {recorder.refused}")
        if self._out.as_json:
            self._out.data({"recorded": str(where), **self._sums(recorder, size_bytes)})
            return
        line_end = "\n" if self._live else ""
        self._out.say(f"{line_end}[bold]recorded[/] {escape(str(where))}: {self._text(recorder, size_bytes)}")

    def _sums(self, recorder: Recorder, size_bytes: int) -> dict[str, float]:
        seconds = round(time.monotonic() - self._began, 3)
        return {
            "messages": recorder.messages,
            "bytes": size_bytes,
            "seconds": seconds,
            "dropped": recorder.dropped,
        }

    def _text(self, recorder: Recorder, size_bytes: int) -> str:
        lost = f", {recorder.dropped} samples lost" if recorder.dropped else ""
        seconds = time.monotonic() - self._began
        return f"{recorder.messages} messages, {size_bytes / _MB:.1f} MB, {seconds:.0f} s{lost}"
