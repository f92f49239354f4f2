"""Robot files that tests of drivers and of simulators share."""

import msgspec

from trade_drivers import Robot
from trade_hil_sim import DeviceState

_DEFAULT_S, _PATIENT_S = 0.25, 1.0
_REST_RAD_S = 0.04
"""A Dynamixel shows speeds up to 0.036 rad/s as one unit or none, which its driver takes for rest."""

HEAD = """
[robot]
name = "rosie"

[bus.neck]
driver = "dynamixel"
port = "/dev/ttyNOWHERE"

[joint."neck.pan"]
bus = "neck"
id = 1
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[joint."neck.tilt"]
bus = "neck"
id = 2
model = "XL430-W250"
reversed = true
min_rad = -0.6
max_rad = 0.6
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[group.head]
joints = ["neck.pan", "neck.tilt"]
"""

HEAD_AND_ARM = (
    HEAD.replace("reversed = true", "reversed = true\noffset_rad = 0.5")
    + """
[bus.arm]
driver = "dynamixel"
port = "/dev/ttyELSEWHERE"
baud = 57600

[joint.elbow]
bus = "arm"
id = 3
model = "XM430-W350"
min_rad = 0.25
max_rad = 1.0
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
)

HAND = """
[robot]
name = "rosie"

[bus.hand]
driver = "robotiq"
port = "/dev/ttyNOHAND"
baud = 115200

[gripper."left.hand"]
bus = "hand"
id = 9
model = "2F-85"
max_width_m = 0.085
max_speed_m_s = 0.15
max_force_n = 200.0
"""

TAIL = """
[robot]
name = "rosie"

[bus.tail]
driver = "feetech"
port = "/dev/ttyNOTAIL"

[joint."tail.root"]
bus = "tail"
id = 1
model = "STS3215"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[joint."tail.tip"]
bus = "tail"
id = 2
model = "STS3215"
reversed = true
min_rad = -0.6
max_rad = 0.6
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[group.tail]
joints = ["tail.root", "tail.tip"]
"""


def patient(robot: Robot) -> Robot:
    """The robot with drivers that wait longer for simulated devices: those share a processor with them and with others.

    Buses that say `stale_after_s` themselves keep it.
    """
    buses = [
        msgspec.structs.replace(bus, stale_after_s=_PATIENT_S) if bus.stale_after_s == _DEFAULT_S else bus
        for bus in robot.buses
    ]
    return msgspec.structs.replace(robot, buses=type(robot.buses)(buses))


def at_rest(device: DeviceState) -> bool:
    """Whether a driver measures it at rest; its planned course may end a moment later."""
    return abs(device.velocity_rad_s) < _REST_RAD_S
