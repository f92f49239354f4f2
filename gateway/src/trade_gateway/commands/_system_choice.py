"""Which system a command speaks to."""

from dataclasses import dataclass, replace

import typer

from trade import Container, Settings


@dataclass(frozen=True)
class SystemChoice:
    """What the options before the command say; the environment and the defaults fill in the rest."""

    system: str | None
    connect: list[str] | None

    def settings(self, container: str | None = None) -> Settings:
        """Settings of a container of this command."""
        return Settings.read(system=self.system, connect=self.connect, container=container)


def choice_of(context: typer.Context) -> SystemChoice:
    """The choice made on the command line."""
    found = context.obj
    assert isinstance(found, SystemChoice)  # noqa: S101 - set by the callback of every command
    return found


def visitor(context: typer.Context) -> Container:
    """A short-lived container of this command's own; what it asks for is in the records of who is asked."""
    return Container(replace(choice_of(context).settings(), audit=None, metrics=""))
