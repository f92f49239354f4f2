"""The gateway's guests: its containers in other systems, which share groups as its file says."""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from trade import Container, Settings
from trade.errors import TradeError
from trade.sharing import Border
from trade_gateway.config._gateway_file import Plan, Share

_TRIES: Final = 5
_AGAIN_S: Final = 0.2


class _Guest:
    """A guest in one other system."""

    def __init__(self, home: Container, settings: Settings, share: Share) -> None:
        with ExitStack() as leaving:
            self.home = home
            self.container = opened(settings)
            leaving.callback(self.container.close)
            self.border = Border(home, self.container, exported=share.export, imported=share.import_)
            leaving.callback(self.border.close)
            self._leaving = leaving.pop_all()

    def close(self) -> None:
        self._leaving.close()


class SystemGuests:
    """The guests in all other systems that a gateway file names."""

    def __init__(self) -> None:
        self._guests: dict[str, _Guest] = {}

    def apply(self, home: Container, plan: Plan) -> None:
        """Opens and closes guests as the file says; unchanged ones are not disturbed.

        Raises:
            ConfigurationError: one of them cannot be started; the others are as the file says.
        """
        for name, guest in self._guests.copy().items():
            if plan.shares.get(name) != guest.container.settings or guest.home is not home:
                self._guests.pop(name).close()
        for name, share in plan.file.share.items():
            guest = self._guests.get(name)
            if guest is None:
                self._guests[name] = _Guest(home, plan.shares[name], share)
            else:
                guest.border.share(exported=share.export, imported=share.import_)

    def close(self) -> None:
        """Leaves all other systems, which stops the motion of their clients. Idempotent."""
        for name in list(self._guests):
            self._guests.pop(name).close()


def opened(settings: Settings, on_terminate: Callable[[], None] | None = None) -> Container:
    """Opens a container; retries while the one before still has its addresses. Raises ConfigurationError."""
    for _ in range(_TRIES - 1):
        try:
            return Container(settings, on_terminate=on_terminate)
        except TradeError:
            threading.Event().wait(_AGAIN_S)
    return Container(settings, on_terminate=on_terminate)
