"""A driver in a process of its own that closes the hand slowly: ``gripper_process.py ROBOT PORT``."""

import sys
from pathlib import Path

import trade_drivers

ROBOT, PORT = sys.argv[1:3]


def main() -> None:
    robot = trade_drivers.parse(Path(ROBOT).read_text(encoding="utf-8"), ROBOT)
    with trade_drivers.attach(robot, announced=False, ports={"hand": PORT}) as attached:
        attached.gripper("left.hand").activate()
        attached.gripper("left.hand").move_to(0.05, 0.02)
        sys.stdin.read()


if __name__ == "__main__":
    main()
