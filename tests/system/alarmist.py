"""A container of the siege that gives e-stops or clears them: ``alarmist.py NAMESPACE NAME ADDRESS``.

Its first line of input is JSON and says the rest: where to ``connect``. Then each line is one command:
``flood N`` gives N e-stops and answers which containers confirmed one of them; ``clear S`` clears all that are open,
for S seconds at most, lets the robots move again, and answers which e-stops still are open.
"""

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Iterable

from trade import Container, Settings, where
from trade.errors import TradeError

_AT_ONCE = 8
_CONFIRMED_WITHIN_S = 2.0
_ROBOTS = ("rosie", "dora")


def flood(container: Container, count: int) -> list[str]:
    confirmed = set[str]()

    def give(numbers: Iterable[int]) -> None:
        for number in numbers:
            report = container.estop(f"number {number} of {count}", limit_s=_CONFIRMED_WITHIN_S)
            confirmed.update(report.confirmed)

    shares = [threading.Thread(target=give, args=(range(at, count, _AT_ONCE),)) for at in range(_AT_ONCE)]
    for share in shares:
        share.start()
    for share in shares:
        share.join()
    return sorted(confirmed)


def clear(container: Container, limit_s: float) -> list[str]:
    until = time.monotonic() + limit_s
    problem = ""
    while time.monotonic() < until:
        try:
            still_open = container.estops()
            if not still_open:
                resume(container)
                return []
            container.estop_clear([estop.id for estop in still_open], limit_s=_CONFIRMED_WITHIN_S)
        except TradeError as error:  # a robot is away; the next try may reach it
            problem = str(error)
            time.sleep(0.2)
    return [*(estop.id for estop in container.estops()), problem]


def resume(container: Container) -> None:
    for robot in _ROBOTS:
        with contextlib.suppress(TradeError):  # it is away, or locked: then its owner resumes it
            container.resume(where(group=robot), wait_s=0)


def main(name: str, address: str) -> None:
    reported = json.loads(sys.stdin.readline())
    settings = Settings.read(
        system=f"{os.environ['TRADE_SYSTEM']}-0",
        container=name,
        listen=[f"tls/{address}"],
        connect=[reported["connect"]],
    )
    with Container(settings) as container:
        for line in sys.stdin:
            command, *words = line.split()
            answer = flood(container, int(words[0])) if command == "flood" else clear(container, float(words[0]))
            print(json.dumps({"answer": answer}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[2:])
