"""What is fuzzed: something that takes bytes from elsewhere, and the errors it may answer them with."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

CORPUS: Final = Path(__file__).parent / "corpus"


class Target(NamedTuple):
    """One reader of bytes. Any other error than a refusal, a hang, or memory without bound is a defect."""

    name: str
    read: Callable[[bytes], Any]
    refusals: tuple[type[Exception], ...] = ()
    write: Callable[[Any], bytes] | None = None
    """What was read, as bytes again; those are read as the same."""

    def takes(self, data: bytes) -> bool:
        """Whether it is taken; False if it is refused as it should be."""
        try:
            value = self.read(data)
        except self.refusals as refused:
            assert str(refused), f"{type(refused).__name__} says nothing"
            return False
        if self.write is not None:
            written = self.write(value)
            again = self.write(self.read(written))
            assert again == written, "what was read is not read again as it was"
        return True

    @property
    def folder(self) -> Path:
        """Where its corpus is kept."""
        return CORPUS / self.name

    @property
    def corpus(self) -> list[Path]:
        """Real messages, and what once broke something (``found-...``)."""
        return sorted(self.folder.glob("*"))
