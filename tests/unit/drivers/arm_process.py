"""A driver in a process of its own that moves the arm slowly: ``arm_process.py ROBOT HOST HOW``."""

import sys
import time
from pathlib import Path

import trade_drivers

ROBOT, HOST, HOW = sys.argv[1:4]


def main() -> None:
    robot = trade_drivers.parse(Path(ROBOT).read_text(encoding="utf-8"), ROBOT)
    with trade_drivers.attach(robot, announced=False, ports={"ur": HOST}) as attached:
        arm = attached.arm("right")
        far = [3.0, *arm.state().positions_rad[1:]]
        if HOW == "move":
            arm.move_joints(far, 0.2)
        while True:
            arm.servo(far, 1.0)
            time.sleep(0.05)


if __name__ == "__main__":
    main()
