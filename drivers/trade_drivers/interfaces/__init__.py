"""The interfaces of devices in SI units: motors, joint groups, grippers, arms, cameras, sensors."""
