"""A behaviour that must survive its robot: calls in a loop, finds again when the service is gone, says what happens."""

import json
import sys
import time

import trade
from trade import errors, where


def main() -> None:
    look = None
    while True:
        try:
            look = look or trade.find(where(name="state", group="rosie.head"), wait_s=0.5).with_(deadline_s=60)
            look()
            say("ok", epoch=look.key.address.epoch)
        except errors.NoSuchService:
            continue
        except errors.TradeError as error:
            say(type(error).__name__)
            look = None
        time.sleep(0.02)


def say(outcome: str, epoch: str = "") -> None:
    json.dump({"outcome": outcome, "epoch": epoch, "t": time.monotonic()}, sys.stdout)
    print(flush=True)


main()
