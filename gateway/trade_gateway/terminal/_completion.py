"""Words that a shell completes from the running system: groups, services, containers and ids.

A completion only reads the registry. Whatever goes wrong, it offers nothing and prints nothing.
"""

import logging
from collections.abc import Callable, Iterable
from contextlib import redirect_stderr
from io import StringIO
from typing import Final

import typer

from trade import Container, Handle
from trade_gateway.terminal._system_choice import SystemChoice, visitor_of

Complete = Callable[[typer.Context, str], list[str]]
_OWN: Final = "trade"
"""The group of the middleware's own services, which is offered only once its first letter is typed."""


def _completion(read: Callable[[Container], Iterable[str]]) -> Complete:
    def complete(context: typer.Context, incomplete: str) -> list[str]:
        logging.disable(logging.CRITICAL)
        words = context.find_root().params
        try:
            with redirect_stderr(StringIO()), visitor_of(SystemChoice(words["system"], words["connect"])) as container:
                found = sorted({word for word in read(container) if word.startswith(incomplete)})
        except Exception:  # noqa: BLE001 - a shell waits for words, and shows nothing else
            return []
        others = [word for word in found if word.partition(".")[0] != _OWN]
        return others or found

    return complete


def _groups(container: Container, handles: Iterable[Handle] | None = None) -> Iterable[str]:
    for handle in container.services() if handles is None else handles:
        for group in handle.groups:
            segments = group.split(".")
            yield from (".".join(segments[:count]) for count in range(1, len(segments) + 1))


def _locked(container: Container) -> Iterable[str]:
    held = {(info.container, name) for info in container.locks() for name in info.resources}
    uses = (
        handle for handle in container.services() if any((handle.container, name) in held for name in handle.resources)
    )
    return _groups(container, uses)


def _others(container: Container) -> Iterable[str]:
    return (info.name for info in container.containers() if info.name != container.name)


groups: Final = _completion(_groups)
locked_groups: Final = _completion(_locked)
services: Final = _completion(lambda container: (handle.label for handle in container.services()))
containers: Final = _completion(_others)
hooks: Final = _completion(lambda container: (info.id for info in container.hooks()))
notifications: Final = _completion(lambda container: (info.id for info in container.notifications()))
