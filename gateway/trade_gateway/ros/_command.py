"""``trade ros``: a bridge between a system and ROS 1 or ROS 2, as a file maps it."""

from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container
from trade_gateway.process._signals import leaving, refuse_twice, settle
from trade_gateway.terminal import sections
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import Json, room_of_extra
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._sd_notify import Notifier
from trade_gateway.terminal._system_choice import SystemChoice

SECTION: Final = sections.ROBOTS
PLACE: Final = 7
_LOOK_EVERY_S: Final = 0.5
_UP_WITHIN_S: Final = 30.0


def ros(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The bridge file; see docs/ros.md.")],
    check: Annotated[bool, typer.Option("--check", help="Check the file, list what it maps, and exit.")] = (False),
    name: Annotated[str, typer.Option(help="Name of the bridge's container.")] = "ros",
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Bridge a system and ROS 1 or ROS 2 until Ctrl-C or SIGTERM.

    Each ROS node is its own client: when it dies, its motion stops and its locks are released.

    For example: trade ros examples/ros.toml --check
    """
    room, out = room_of_extra("ros", "trade ros"), Output(as_json=as_json)
    read = room.read_ros_file(file)
    if check:
        _say_checked(out, file, room.planned(read, file))
        return
    room.planned(read, file)  # reports wrong types before it joins anything
    choice: SystemChoice = context.obj

    def say(line: str) -> None:
        out.say(escape(line))

    if detach:
        detach_now(out, choice.settings(name))
        return
    with (
        Notifier() as notifier,
        leaving() as asked_to_leave,
        Container(choice.settings(name), on_terminate=asked_to_leave.set) as container,
    ):
        refuse_twice(container, "trade ros")
        if container.access.policy is None:
            complain("there is no policy: every ROS node may call what the file maps; see docs/ros.md")
        graph = room.join(read, file)
        try:
            bridge = room.Bridge(container, graph, read, say)
            try:
                bridge.settled(_UP_WITHIN_S)
                settle()
                _say_ready(out, container, read.ros.node)
                notifier.ready(f"ROS {read.ros.version} is bridged by container {container.name}")
                while not asked_to_leave.wait(_LOOK_EVERY_S):
                    if container.healthy():
                        notifier.alive()
                notifier.leaving()
                out.say("leaving")
            finally:
                bridge.close()
        finally:
            graph.close()


def _say_checked(out: Output, file: Path, planned: list[str]) -> None:
    if out.as_json:
        out.data({"file": str(file), "maps": planned})
        return
    for line in planned:
        out.say(escape(line))
    out.say(f"{escape(str(file))} is right")


def _say_ready(out: Output, container: Container, node: str) -> None:
    if out.as_json:
        out.data({**ready(container), "node": node})
        return
    out.say(
        f"[bold green]bridged[/]: {escape(node)} in ROS, {escape(container.name)} in system "
        f"{escape(container.settings.system)}; Ctrl-C ends it"
    )
