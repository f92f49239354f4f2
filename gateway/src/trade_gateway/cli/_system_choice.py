"""Which system a command speaks to."""

from dataclasses import dataclass, replace
from typing import Final

import typer

from trade import Container, Settings

_PATIENCE_S: Final = 3.0
"""How long nobody may be found where the settings say that it is to connect to."""


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


def visitor_among_others(context: typer.Context) -> Container:
    """The same for who asks what there is: where the settings say whom to connect to, somebody has to be there.

    Raises:
        NobodyFound: nobody is, at any of these endpoints; says why, as far as is known.
    """
    container = visitor(context)
    try:
        if container.settings.connect and len(container.addresses()) == 1:
            reachability = container.reachability(limit_s=_PATIENCE_S)
            if not reachability.others:
                raise reachability.nobody(container.settings.system)
    except BaseException:
        container.close()
        raise
    return container
