"""What an agent is refused, and what it can do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

from trade.errors import CallerError

__all__ = ["NeedsApproval", "NeedsLock", "NoSuchTool", "NoTwin", "WrongTool"]


@dataclass(kw_only=True, eq=False)
class NeedsLock(CallerError, PermissionError):
    """An agent moves only what it has locked; nothing was done."""

    service: str
    resources: Sequence[str]

    def describe(self) -> str:
        return f"{self.service} uses {', '.join(self.resources)}; take a lock over its group first (tool lock)"


@dataclass(kw_only=True, eq=False)
class NeedsApproval(CallerError, PermissionError):
    """A person who was asked did not say yes; nothing was done."""

    service: str
    reason: str

    def describe(self) -> str:
        return f"{self.service} needs somebody's approval: {self.reason}"


@dataclass(kw_only=True, eq=False)
class NoTwin(CallerError, LookupError):
    """There is nothing to try it on; nothing was done."""

    reason: str

    def describe(self) -> str:
        return f"{self.reason}; start the server with --twin ROBOT.toml for a simulated one"


@dataclass(kw_only=True, eq=False)
class WrongTool(CallerError, ValueError):
    """The arguments of a tool are wrong; nothing was done."""

    problem: str

    def describe(self) -> str:
        return self.problem


@dataclass(kw_only=True, eq=False)
class NoSuchTool(CallerError, LookupError):
    """There is no such tool."""

    name: str
    known: Sequence[str]

    def describe(self) -> str:
        return f"there is no tool {self.name!r}; there is {', '.join(self.known)}"
