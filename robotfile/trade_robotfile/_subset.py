"""Removes parts from a robot file, for example when a device is missing."""

from collections.abc import Iterable

from msgspec.structs import replace

from trade_robotfile._convert import RobotFileError
from trade_robotfile._records import Robot


def without(robot: Robot, names: Iterable[str]) -> tuple[Robot, list[str]]:
    """Returns the robot as if some of its buses, cameras or sensors were not in its file.

    With a bus, its devices are removed, and with a joint, all groups that contain it.

    Args:
        robot: the result of ``load``.
        names: of buses, cameras and sensors.

    Returns:
        The rest, and the names of all removed devices and groups.

    Raises:
        RobotFileError: there is no such part, a remaining joint is coupled to a removed one, or nothing remains.
    """
    out = set(names)
    known = {each.name for each in (*robot.buses, *robot.cameras, *robot.sensors)}
    if unknown := sorted(out - known):
        problem = f"there is no bus, camera or sensor {unknown[0]!r} to leave out; there is {', '.join(sorted(known))}"
        raise RobotFileError(problem, robot.where)
    gone = {device.name for device in (*robot.joints, *robot.grippers, *robot.arms) if device.bus in out}
    _check_coupled(robot, gone)
    groups = [group for group in robot.groups if gone.isdisjoint(group.joints)]
    rest = replace(
        robot,
        buses=[bus for bus in robot.buses if bus.name not in out],
        joints=[joint for joint in robot.joints if joint.name not in gone],
        grippers=[gripper for gripper in robot.grippers if gripper.name not in gone],
        arms=[arm for arm in robot.arms if arm.name not in gone],
        cameras=[camera for camera in robot.cameras if camera.name not in out],
        sensors=[sensor for sensor in robot.sensors if sensor.name not in out],
        groups=groups,
        coupled=[coupled for coupled in robot.coupled if gone.isdisjoint(coupled.joints)],
    )
    if not (rest.joints or rest.grippers or rest.arms or rest.cameras or rest.sensors):
        raise RobotFileError("nothing would be left of the robot", robot.where)
    senses = (each.name for each in (*robot.cameras, *robot.sensors) if each.name in out)
    return rest, [*_in_order(robot, gone), *senses, *(group.name for group in robot.groups if group not in groups)]


def _in_order(robot: Robot, names: set[str]) -> list[str]:
    return [device.name for device in (*robot.joints, *robot.grippers, *robot.arms) if device.name in names]


def _check_coupled(robot: Robot, gone: set[str]) -> None:
    for coupled in robot.coupled:
        stays = [joint for joint in coupled.joints if joint not in gone]
        goes = [joint for joint in coupled.joints if joint in gone]
        if stays and goes:
            bus = next(joint.bus for joint in robot.joints if joint.name == stays[0])
            problem = f"{stays[0]} is coupled to {goes[0]}, which is left out; leave out bus {bus!r} as well"
            raise RobotFileError(problem, robot.where)
