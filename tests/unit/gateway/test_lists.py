"""Each command that lists what runs, in a terminal of 80 columns: no line is wider, however long the names are."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from trade import Container, service, where

TRADE: Final = Path(sys.executable).with_name("trade")
COLUMNS: Final = 80
GROUP: Final = "laboratory_of_mobile_manipulation.left_arm_of_the_second_robot.gripper"
LISTS: Final = (
    ("services",),
    ("containers",),
    ("containers", "--load"),
    ("containers", "--show", "links"),
    ("containers", "--show", "network"),
    ("locks",),
    ("hooks",),
    ("notifications",),
    ("faults",),
    ("rules", "list"),
    ("trace",),
    ("profile",),
    ("approvals",),
)


class Gripper:
    @service
    def moved_to_the_place_where_the_object_was_last_seen(
        self, position_m_in_the_frame_of_the_robot: list[float], speed_m_s: float | None = None
    ) -> None: ...


NAME: Final = Gripper.moved_to_the_place_where_the_object_was_last_seen.__name__


@pytest.fixture
def crowded(start_container: Callable[..., Container]) -> Container:
    """A system with one of everything that is listed, under long names."""
    robot = start_container("a_robot_with_a_name_that_hardly_fits_into_a_terminal_of_eighty_columns")
    robot.register(Gripper(), GROUP)
    move = robot.find(where(name=NAME))
    robot.after_service(f"{GROUP}.{NAME}", move)
    robot.every(3600, move)
    return robot


def shown(*words: str) -> list[str]:
    """The lines of a command in a terminal of that width."""
    screen, inside = pty.openpty()
    fcntl.ioctl(inside, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"TERM": "dumb"}
    with subprocess.Popen([TRADE, *words], stdout=inside, stderr=inside, env=environment) as program:
        os.close(inside)
        said = b""
        try:
            while some := os.read(screen, 65536):
                said += some
        except OSError:  # the end of a pseudo-terminal
            pass
    os.close(screen)
    assert program.returncode == 0, said
    return said.decode().splitlines()


@pytest.mark.realtime
@pytest.mark.parametrize("words", LISTS, ids=" ".join)
def test_a_list_is_no_wider_than_the_terminal(crowded: Container, words: tuple[str, ...]) -> None:
    with crowded.lock(GROUP, purpose="a handover to the person who asked for the object a minute ago"):
        lines = shown(*words)
    assert lines
    assert [line for line in lines if len(line) > COLUMNS] == []
