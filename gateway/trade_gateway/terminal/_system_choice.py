"""The system that a command connects to."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import typer

from trade import Container, Settings
from trade_gateway.terminal._output import complain

_PATIENCE_S: Final = 3.0
"""How long to wait for a container at the endpoints of the settings, in seconds."""
_LINK_S: Final = 2.0
"""How long to wait for links to the containers that this one sees, in seconds."""


@dataclass(frozen=True)
class SystemChoice:
    """The options before the command; the environment and the defaults fill in the rest."""

    system: str | None
    connect: list[str] | None

    def settings(self, container: str | None = None) -> Settings:
        """Returns the settings of a container of this command."""
        return Settings.read(system=self.system, connect=self.connect, container=container)


def choice_of(context: typer.Context) -> SystemChoice:
    """Returns the choice made on the command line."""
    found = context.obj
    assert isinstance(found, SystemChoice)  # noqa: S101 - set by the callback of every command
    return found


def visitor_of(
    choice: SystemChoice, name: str | None = None, *, on_terminate: Callable[[], None] | None = None
) -> Container:
    """Opens a short-lived container; the containers that it calls keep the audit records."""
    return Container(replace(choice.settings(name), audit=None, metrics=""), on_terminate=on_terminate)


def visitor(
    context: typer.Context, name: str | None = None, *, on_terminate: Callable[[], None] | None = None
) -> Container:
    """Opens a short-lived container for this command."""
    return visitor_of(choice_of(context), name, on_terminate=on_terminate)


def visitor_among_others(context: typer.Context) -> Container:
    """Opens the same for queries: if the settings name endpoints, one of them has to answer.

    It warns of containers that others see and this command does not.

    Raises:
        NoContainerFound: none of these endpoints answers; with the reason, if known.
    """
    container = visitor(context)
    try:
        if container.settings.connect and len(container.addresses()) == 1:
            reachability = container.reachability(limit_s=_PATIENCE_S)
            if not reachability.others:
                raise reachability.as_error(container.settings.system)
        if container.settings.connect:
            for sentence in container.beyond(wait_s=_LINK_S):
                complain(sentence)
    except BaseException:
        container.close()
        raise
    return container
