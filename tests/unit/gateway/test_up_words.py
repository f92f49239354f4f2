"""``trade up``: what its words mean before anything is opened."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.support.simulated_robots import HAND, TAIL
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli.robots._up import ports_named


def test_a_port_of_the_command_line_may_have_any_sign_in_it() -> None:
    assert ports_named(["neck=/dev/by=id", "legs=socketcan:can1"]) == {"neck": "/dev/by=id", "legs": "socketcan:can1"}
    assert ports_named([]) == {}


@pytest.mark.parametrize("words", [["neck"], ["neck="], ["=/dev/ttyUSB0"], ["neck=/dev/ttyUSB0", "neck=/dev/ttyUSB1"]])
def test_what_is_no_port_of_a_part_is_refused(words: list[str]) -> None:
    with pytest.raises(UsageError, match="--port"):
        ports_named(words)


def test_a_check_of_a_right_file_says_so_and_touches_nothing(system: str, tmp_path: Path) -> None:
    path = tmp_path / "tail.toml"
    path.write_text(TAIL)  # its port is nowhere
    said = CliRunner().invoke(app, ["up", str(path), "--check"])
    assert (said.exit_code, said.output) == (0, f"{path} is right\n")
    assert not (tmp_path / "state").exists()


WRONG = {
    "min_rad": (TAIL.replace("min_rad = -1.4", "min_rad = -70"), 'joint."tail.root".min_rad'),
    "force": (HAND.replace("200.0", "5"), 'gripper."left.hand".max_force_n'),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("of", ["robot", "gateway", "system"])
def test_a_check_refuses_what_the_drivers_of_a_robot_would_refuse(
    system: str, tmp_path: Path, wrong: str, of: str
) -> None:
    text, key = WRONG[wrong]
    robot, gateway, lab = (tmp_path / name for name in ("rosie.toml", "gate.toml", "lab.toml"))
    robot.write_text(text)
    gateway.write_text('system = "lab"\n[container.rosie]\nrobot = "rosie.toml"\n')
    lab.write_text('[system]\nname = "lab"\n[container.rosie]\nrobot = "rosie.toml"\n')
    words = {"robot": ["up", str(robot)], "gateway": ["gateway", str(gateway)], "system": ["system", "up", str(lab)]}
    said = CliRunner().invoke(app, [*words[of], "--check"])
    assert said.exit_code == 1
    assert f"{robot}: {key}" in str(said.exception)


def test_what_is_left_out_is_not_checked(system: str, tmp_path: Path) -> None:
    path = tmp_path / "rosie.toml"
    path.write_text(TAIL + HAND.replace("200.0", "5").split('"rosie"')[1])
    assert CliRunner().invoke(app, ["up", str(path), "--check", "--without", "hand"]).exit_code == 0
    assert CliRunner().invoke(app, ["up", str(path), "--check"]).exit_code == 1
