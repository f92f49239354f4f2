"""Robot files that tests of drivers and of simulators share."""

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
