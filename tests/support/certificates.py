"""Folders with certificates for tests."""

from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from trade_gateway.pki._authority import Authority


@dataclass
class Papers:
    """An authority of its own, and a folder for each name."""

    folder: Path
    authority: Authority = field(init=False)

    def __post_init__(self) -> None:
        self.authority = Authority.create(self.folder)

    def of(self, name: str, **options: object) -> Path:
        """The folder of a name, issued or renewed now."""
        return self.authority.issue(name, **options).folder  # type: ignore[arg-type]

    def expired(self, name: str) -> Path:
        return self.of(name, lasts=timedelta(minutes=-1))
