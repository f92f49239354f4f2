"""A driver in a process of its own that moves the head slowly and reports: ``driver_process.py ROBOT PORT``."""

import sys
from pathlib import Path

import trade_drivers

ROBOT, PORT = sys.argv[1:3]


def main() -> None:
    robot = trade_drivers.parse(Path(ROBOT).read_text(encoding="utf-8"), ROBOT)
    with trade_drivers.attach(
        robot, register=lambda provider, groups: None, deregister=lambda provider: None, ports={"neck": PORT}
    ) as head:
        print("attached", flush=True)
        try:
            head.motor("neck.pan").move_to(1.3, 0.1)
        except Exception as error:  # noqa: BLE001 - the parent reads which
            print(type(error).__name__, error, flush=True)
        for line in sys.stdin:
            print(line.strip(), flush=True)


if __name__ == "__main__":
    main()
