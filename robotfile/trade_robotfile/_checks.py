"""Checks of a robot file as a whole: its buses exist, names and ids are unique, limits are in order."""

from trade_robotfile._convert import wrong
from trade_robotfile._records import Arm, CanBus, Robot, arm_problem


def check_links(robot: Robot) -> None:
    _check_ports(robot)
    _check_devices(robot)
    for joint in robot.joints:
        if not joint.min_rad < joint.max_rad:
            problem = f"must be greater than min_rad, but {joint.max_rad} <= {joint.min_rad}"
            raise wrong(robot.where, f'joint."{joint.name}".max_rad', problem)
    for gripper in robot.grippers:
        if not gripper.min_width_m < gripper.max_width_m:
            problem = f"must be greater than min_width_m, but {gripper.max_width_m} <= {gripper.min_width_m}"
            raise wrong(robot.where, f'gripper."{gripper.name}".max_width_m', problem)
    for arm in robot.arms:
        if (bad := arm_problem(arm)) is not None:
            raise wrong(robot.where, f'arm."{arm.name}".{bad[0]}', bad[1])
    _check_groups(robot)
    _check_taken(robot)


def _check_taken(robot: Robot) -> None:
    """Checks that no device has a name that drivers use themselves."""
    devices = (*robot.joints, *robot.grippers, *robot.arms, *robot.cameras, *robot.sensors, *robot.groups)
    taken = {"faults": "the fault log"}
    taken |= {f"bus.{bus.name}": "the bus itself" for bus in robot.buses if isinstance(bus, CanBus)}
    for device in devices:
        if (what := taken.get(device.name)) is not None:
            kind, full = type(device).__name__.lower(), f"{robot.name}.{device.name}"
            raise wrong(robot.where, f'{kind}."{device.name}"', f"{full} is {what}; name the {kind}s otherwise")


def _check_devices(robot: Robot) -> None:
    """Checks that there is a device, and that each has an existing bus, a unique id and a unique name."""
    devices = (*robot.joints, *robot.grippers, *robot.arms)
    if not (devices or robot.cameras or robot.sensors):
        problem = "missing; a robot needs at least one joint, gripper, arm, camera or sensor"
        raise wrong(robot.where, "[joint.NAME]", problem)
    buses, names, seen = {bus.name for bus in robot.buses}, set[str](), dict[tuple[str, int], str]()
    for device in devices:
        kind = type(device).__name__.lower()
        key = f'{kind}."{device.name}"'
        if device.bus not in buses:
            problem = f"there is no bus {device.bus!r}; there is {', '.join(sorted(buses)) or 'none'}"
            raise wrong(robot.where, f"{key}.bus", problem)
        number = -1 if isinstance(device, Arm) else device.id
        if other := seen.get((device.bus, number)):
            if number < 0:
                raise wrong(robot.where, f"{key}.bus", f"controller {device.bus!r} has its one arm: {other}")
            raise wrong(robot.where, f"{key}.id", f"{number} is taken on bus {device.bus!r} by {other}")
        if device.name in names:
            raise wrong(robot.where, key, "a joint has this name already")
        names.add(device.name)
        seen[device.bus, number] = f"{kind} {device.name!r}"
    for sense in (*robot.cameras, *robot.sensors):
        if sense.name in names | buses:
            raise wrong(robot.where, sense.key, "a device or a bus has this name already")
        names.add(sense.name)


def _check_ports(robot: Robot) -> None:
    owners = dict[str, str]()
    for bus in robot.buses:
        if other := owners.get(bus.port):
            raise wrong(robot.where, f"bus.{bus.name}.port", f"{bus.port} is the port of bus {other!r} already")
        owners[bus.port] = bus.name


def _check_groups(robot: Robot) -> None:
    names = {joint.name for joint in robot.joints}
    others = (*robot.grippers, *robot.arms, *robot.cameras, *robot.sensors)
    for group in robot.groups:
        _check_joints(robot, group.joints, f"group.{group.name}.joints", names)
        _check_process(robot, group.joints, f"group.{group.name}.joints")
        if group.name in names | {device.name for device in others}:
            raise wrong(robot.where, f"group.{group.name}", "a device has this name already")
    for number, coupled in enumerate(robot.coupled, 1):
        _check_joints(robot, coupled.joints, f"coupled {number}.joints", names)
        _check_process(robot, coupled.joints, f"coupled {number}.joints")


def _check_process(robot: Robot, joints: list[str], key: str) -> None:
    """Checks that joints which move or are locked together are driven by one process."""
    bus_of = {joint.name: joint.bus for joint in robot.joints}
    own = {bus.name for bus in robot.buses if bus.process == "own"}
    inside = next((joint for joint in joints if bus_of[joint] in own), None)
    if inside is None:
        return
    for joint in joints:
        if bus_of[joint] != bus_of[inside]:
            problem = (
                f"{inside} is on bus {bus_of[inside]!r} with a process of its own, and {joint} is not; "
                f'leave out process = "own", or take joints of one bus'
            )
            raise wrong(robot.where, key, problem)


def _check_joints(robot: Robot, joints: list[str], key: str, names: set[str]) -> None:
    for joint in joints:
        if joint not in names:
            raise wrong(robot.where, key, f"there is no joint {joint!r}; there is {', '.join(sorted(names))}")
    if len(set(joints)) < len(joints):
        raise wrong(robot.where, key, f"names a joint twice: {joints}")
