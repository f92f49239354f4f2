"""Writes down where rosie's head was sent, and looks at the lamp every hour; until Ctrl-C or SIGTERM.

Once `trade system up examples/system.toml` has brought her up: TRADE_SYSTEM=home python examples/watch.py
"""

import logging
import signal

import trade
from trade import HookEvent, Settings, service, where


class Diary:
    @service(effect="read")
    def note(self, called: HookEvent) -> None:
        """Write a call down, where `trade logs` finds it."""
        logging.getLogger("trade").warning("the head was sent to %s", called.args["positions_rad"])


trade.start(Settings.read(container="diary"))
[note] = trade.register(Diary(), "home.diary")
trade.after_service(where(name="move_to", group="rosie.head"), note)
trade.every(s=3600, call=where(name="level", group="home.hall"))
print("watching", flush=True)
signal.sigwait({signal.SIGINT, signal.SIGTERM})
