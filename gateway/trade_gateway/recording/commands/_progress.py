"""Makes a recording for the command line, with output of its progress."""

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.markup import escape

from trade.errors import ConfigurationError
from trade_gateway.recording._fault_trigger import SavedAtFault
from trade_gateway.recording._file import Attachment, RecordingFile
from trade_gateway.recording._recorder import Recorder, Ring, about
from trade_gateway.terminal._detached import ready
from trade_gateway.terminal._output import Output, complain

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
    """Records to one file until it is asked to end.

    Raises:
        ConfigurationError: the file cannot be made, or the disk is full; the file is then readable so far.
    """
    progress, file = _Progress(out), RecordingFile(path, about, attachments)

    def beat() -> None:
        file.flush()
        progress.beat(recorder, file.size_bytes)

    try:
        with file:
            progress.begin(recorder, file.path)
            recorder.run(file, seconds, beat)
    except OSError as bad:
        problem = f"{bad.strerror}; the file ends here and is readable, with {file.size_bytes / _MB:.1f} MB"
        raise ConfigurationError(where=str(file.path), problem=problem) from None
    progress.end(recorder, file.path, file.size_bytes)


def kept_for_faults(
    folder: Path,
    ring: Ring,
    out: Output,
    recorder: Recorder,
    about: Mapping[str, str],
    attachments: Sequence[Attachment],
    seconds: float | None,
) -> None:
    """Keeps the last seconds in memory until it is asked to end, and saves them at each fault.

    Raises:
        ConfigurationError: the folder cannot be made.
    """
    progress = _Progress(out)
    sink = SavedAtFault(folder, ring, about, attachments, progress.saved, complain)
    progress.begin(recorder, folder)
    recorder.run(sink, seconds, lambda: progress.beat(recorder, ring.size_bytes))
    progress.end(recorder, folder, ring.size_bytes)
    if ring.cut_short:
        complain(f"{ring.cut_short} messages were dropped early; --most-mb gives them more memory")


class _Progress:
    """Output while a recording runs."""

    def __init__(self, out: Output) -> None:
        self._stream = out
        self._began = time.monotonic()
        self._live = sys.stdout.isatty() and not out.as_json

    def begin(self, recorder: Recorder, where: Path) -> None:
        """Prints the recorded services and the destination."""
        services = recorder.look()
        if self._stream.as_json:
            self._stream.data({**ready(recorder.container), "recording": str(where), "services": services})
            return
        named = ", ".join(services) or "no service with joints or pictures yet"
        self._stream.say(f"[bold]recording[/] to {escape(str(where))}: {escape(named)}; Ctrl-C ends")

    def beat(self, recorder: Recorder, size_bytes: int) -> None:
        """Prints the progress: one line that is overwritten in a terminal, one line per second for programs."""
        if self._stream.as_json:
            self._stream.data(self._sums(recorder, size_bytes))
        elif self._live:
            print(f"\r{self._text(recorder, size_bytes)} ", end="", flush=True)  # noqa: T201 - Console ends lines

    def saved(self, path: Path, reason: str, messages: int) -> None:
        """Reports that a file of the last seconds was written."""
        if self._stream.as_json:
            self._stream.data({"saved": str(path), "why": reason, "messages": messages})
        else:
            self._stream.say(f"[bold red]{escape(reason)}[/]: saved {messages} messages to {escape(str(path))}")

    def end(self, recorder: Recorder, where: Path, size_bytes: int) -> None:
        """Prints the totals, and what was not recorded."""
        if recorder.refused:
            complain(f"some data was not recorded: {recorder.refused}")
        if self._stream.as_json:
            self._stream.data({"recorded": str(where), **self._sums(recorder, size_bytes)})
            return
        line_end = "\n" if self._live else ""
        self._stream.say(f"{line_end}[bold]recorded[/] {escape(str(where))}: {self._text(recorder, size_bytes)}")

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
