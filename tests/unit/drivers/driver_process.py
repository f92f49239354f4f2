"""A driver in a process of its own that moves a joint slowly: ``driver_process.py ROBOT PORT [BUS JOINT]``.

Then each line, a joint and an angle, enables and moves one, and is answered with where it has come to, or an error.
"""

import sys
from pathlib import Path

import trade_drivers
from trade.errors import TradeError

ROBOT, PORT = sys.argv[1:3]
BUS, JOINT = sys.argv[3:5] or ("neck", "neck.pan")


def main() -> None:
    robot = trade_drivers.parse(Path(ROBOT).read_text(encoding="utf-8"), ROBOT)
    with trade_drivers.attach(robot, announced=False, ports={BUS: PORT}) as head:
        print("attached", flush=True)
        try:
            motor = head.motor(JOINT)
            motor.move_to(0.93 * motor.limits().max_rad, 0.1)
            print("moved", flush=True)
        except Exception as error:  # noqa: BLE001 - the parent reads which
            print(type(error).__name__, error, flush=True)
        for line in sys.stdin:
            joint, angle = line.split()
            print(moved(head.motor(joint), float(angle)), flush=True)


def moved(motor: trade_drivers.Motor, angle_rad: float) -> str:
    """Where it has come to, or why not."""
    try:
        motor.enable()
        return f"{motor.move_to(angle_rad):.1f}"
    except TradeError as error:
        return f"{type(error).__name__} {error}"


if __name__ == "__main__":
    main()
