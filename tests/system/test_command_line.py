import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import trade
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import DORA, ROOT, ROSIES_HEAD
from trade import where
from trade_hil_sim import SimControl, SimProcess, events, motion_writes, read_log

Command = Callable[..., subprocess.CompletedProcess[str]]


class JamError(Exception):
    """Of a module that the command line does not import."""


class Careless:
    @trade.service
    def fail(self, kind: str) -> None:
        self._close({"jam": JamError, "key": KeyError}.get(kind, RuntimeError))

    def _close(self, kind: type[Exception]) -> None:
        raise kind("the gripper is jammed")


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("plain", "RuntimeError: the gripper is jammed"),
        ("key", "KeyError: 'the gripper is jammed'"),
        ("jam", "RemoteError: left.hand.fail raised tests.system.test_command_line:JamError: the gripper is jammed"),
    ],
)
def test_what_a_provider_raises_is_its_message_its_place_and_on_request_its_traceback(
    system: str, trade_command: Command, kind: str, named: str
) -> None:
    trade.register(Careless(), "left.hand")
    failed = trade_command("call", "left.hand.fail", kind)
    assert (failed.returncode, failed.stdout) == (1, "")
    first, *lines = failed.stderr.splitlines()
    assert first == named
    assert len(lines) == 3
    assert re.fullmatch(rf"  raised by the provider in {re.escape(__file__)}, line \d+, in _close:", lines[0])
    assert [line.strip() for line in lines[1:]] == [
        'raise kind("the gripper is jammed")',
        "--traceback shows the whole traceback",
    ]
    whole = trade_command("call", "left.hand.fail", kind, "--traceback").stderr
    assert whole.startswith("Traceback (most recent call last):")
    assert "in fail" in whole
    assert "trade_gateway" not in whole  # the command line's own functions say nothing about it
    said = json.loads(trade_command("call", "left.hand.fail", kind, "--json").stderr)
    assert said["message"] in named
    assert "in _close" in said["data"]["traceback"]


def test_services_of_a_robot_are_listed_as_json(rosie_up, trade_command: Command) -> None:
    rosie_up()
    listed = trade_command("services", "--group", "rosie", "--json")
    services = {entry["service"]: entry for entry in json.loads(listed.stdout)}
    assert services["rosie.head.move_to"]["effect"] == "actuate"
    assert services["rosie.head.move_to"]["resources"] == ["rosie.neck.pan", "rosie.neck.tilt"]
    assert services["rosie.neck.pan.stop"]["container"] == "rosie"


def test_a_call_moves_the_simulated_servos_and_prints_where_they_are(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    called = trade_command("call", "rosie.head.move_to", "[0.3, -0.2]", "--json")
    assert called.returncode == 0, called.stderr
    assert json.loads(called.stdout) == pytest.approx([0.3, -0.2], abs=0.02)
    rests = {entry.joint: entry.position_rad for entry in events(read_log(rosie.log), "at_rest")}
    assert [rests["neck.pan"], rests["neck.tilt"]] == pytest.approx([0.3, -0.2], abs=0.02)


def test_a_robot_on_two_buses_comes_up(run, tmp_path, trade_command: Command) -> None:
    log = tmp_path / "bytes.jsonl"
    run("-m", "trade_gateway", "up", DORA, "--sim", "--sim-log", log, "--json").json()
    called = trade_command("call", "dora.right_arm.move_to", "[0.3, 0.2, -0.1]", "--json")
    assert called.returncode == 0, called.stderr
    rests = {entry.joint: entry.position_rad for entry in events(read_log(log), "at_rest")}
    assert rests == pytest.approx({"right.shoulder": 0.3, "right.elbow": 0.2, "right.wrist": -0.1}, abs=0.02)


def test_a_negative_number_and_a_named_argument_are_no_options(rosie_up, trade_command: Command) -> None:
    rosie_up()
    called = trade_command("call", "rosie.neck.pan.move_to", "-0.2", "speed_rad_s=1.5", "--json")
    assert json.loads(called.stdout) == pytest.approx(-0.2, abs=0.02)


def test_the_states_of_all_joints_are_one_stream_of_json_lines(rosie_up, trade_command: Command) -> None:
    rosie_up()
    printed = trade_command("stream", "rosie.head.state", "--hz", "50", "--count", "4", "--json")
    assert printed.returncode == 0, printed.stderr
    samples = [json.loads(line) for line in printed.stdout.splitlines()]
    assert [sample["number"] for sample in samples] == [1, 2, 3, 4]
    assert all(
        [joint["name"] for joint in sample["value"]] == ["rosie.neck.pan", "rosie.neck.tilt"] for sample in samples
    )


def test_a_service_that_moves_cannot_be_streamed(rosie_up, trade_command: Command) -> None:
    rosie_up()
    refused = trade_command("stream", "rosie.head.move_to")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "it does not only read" in refused.stderr


def test_containers_are_listed(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    [container] = json.loads(trade_command("containers", "--json").stdout)
    assert (container["name"], container["pid"]) == ("rosie", rosie.program.process.pid)


def test_loads_are_of_the_second_before_and_the_command_itself_is_left_out(rosie_up, trade_command: Command) -> None:
    rosie_up()
    [load] = json.loads(trade_command("containers", "--load", "--json").stdout)
    assert load["container"] == "rosie"
    assert load["calls"] >= 2
    assert load["cpu_percent"] > 0
    head, row = trade_command("containers", "--load").stdout.splitlines()
    assert head.split()[:2] == ["CONTAINER", "CPU"]
    assert row.split()[0] == "rosie"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["call", "rosie.head.move_to", "[3.0, 0.0]"], "LimitExceeded: rosie.neck.pan: 3 rad is outside -1.4 to 1.4"),
        (["call", "rosie.head.move_to", "[0.1]"], "InvalidArgument"),
        (["call", "rosie.head.move_to", '["left", 0]'], "InvalidArgument: rosie.head.move_to argument 'positions_rad'"),
        (["call", "rosie.head.move_to"], "argument 'positions_rad': missing"),
        (["call", "rosie.head.move_to", "[0.1, 0.1]", "haste=3"], "there is no such argument"),
        (["call", "rosie.head.mvoe_to", "[0.1]", "--wait", "0"], "Did you mean rosie.head.move_to"),
        (["call", "rosie.neck.move_to", "0.1"], "TooManyServices: 2 services match"),
    ],
)
def test_a_bad_call_is_one_line_that_says_what_to_do_and_moves_nothing(
    words: list[str], complaint: str, rosie_up, trade_command: Command
) -> None:
    rosie = rosie_up()
    called = trade_command(*words)
    assert called.returncode == (3 if called.stderr.startswith("NoSuchService") else 1)
    assert complaint in called.stderr
    assert len(called.stderr.strip().splitlines()) == 1
    assert motion_writes(read_log(rosie.log)) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["call", "rosie.head.move_to", "[0.1, NaN]"], "UsageError: argument '[0.1, NaN]': is not JSON"),
        (["call", "rosie.head.move_to", "[0.1,", "-0.2]"], "forgot quotes? The shell splits at spaces: '[0.1, -0.2]'"),
        (["call", "rosie.*.stop"], "UsageError: service 'rosie.*.stop': group='rosie.*' would match nothing"),
        (["services", "--group", "rosie*"], "UsageError: --group rosie*: group='rosie*' would match nothing"),
        (["up", ROSIES_HEAD, "--sim-log", "log"], "UsageError: --sim-log: needs --sim: it is the simulator's log"),
    ],
)
def test_wrong_arguments_are_one_line_and_exit_code_2(words: list[str], complaint: str, trade_command: Command) -> None:
    ended = trade_command(*words)
    assert ended.returncode == 2
    assert complaint in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1


def test_tables_in_a_pipe_are_whole_lines(rosie_up, trade_command: Command) -> None:
    rosie_up()
    lines = trade_command("services", "--group", "rosie.head").stdout.splitlines()
    moves = [line for line in lines if line.startswith("rosie.head.move_to")]
    assert len(lines) == 10  # the head line, and a line a service
    assert "move_to(positions_rad: list[float], speed_rad_s: float (> 0) | None = None) -> list[float]  act" in moves[0]


def test_an_unknown_group_is_answered_with_the_known_groups(rosie_up, trade_command: Command) -> None:
    rosie_up()
    said = trade_command("services", "--group", "roise").stdout
    assert (
        said == "no services match group='roise'; there is rosie.faults, rosie.head, rosie.neck.pan, rosie.neck.tilt\n"
    )


def test_faults_that_latch_and_heal_are_reported_with_their_remedy(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    assert trade_command("call", "rosie.neck.pan.enable").returncode == 0
    with SimControl(rosie.ready["control"]) as control:
        control.brown_out([1])
    reported = rosie.program.wait_for(lambda line: line["joint"] == "rosie.neck.pan" and "enable" in line["fault"])
    assert reported["fault"].endswith("When you have looked: trade call rosie.neck.pan.enable")
    assert reported["at"].startswith("2")
    assert trade_command("call", "rosie.neck.pan.enable").returncode == 0
    assert rosie.program.wait_for(lambda line: line["joint"] == "rosie.neck.pan")["fault"] == ""


def test_S19_silence_is_reported_once_with_its_time_and_joints_not_seen_at_rest_are_named(rosie_up) -> None:
    rosie = rosie_up()
    with SimControl(rosie.ready["control"]) as control:
        control.mute([1, 2])
    reported = {rosie.program.wait_for(lambda line: "did not answer" in line["fault"])["joint"] for _ in range(2)}
    assert reported == {"rosie.neck.pan", "rosie.neck.tilt"}
    rosie.program.signal(signal.SIGINT)
    rosie.program.wait()
    said = [line for line in rosie.program.errors if "rosie.neck.pan" in line]
    silent = [line for line in said if "DeviceSilent" in line]  # if it was to be left before its silence was certain
    assert len(silent) <= 1
    [left] = [line for line in said if line not in silent]
    assert left == "warning: shut down without confirmation that these are at rest: rosie.neck.pan, rosie.neck.tilt\n"


def test_a_watchdog_that_expired_under_an_earlier_driver_is_reported_at_attach(system: str, run, tmp_path) -> None:
    with SimProcess(ROSIES_HEAD) as sim:
        robot_file = tmp_path / "rosie.toml"
        text = ROSIES_HEAD.read_text(encoding="utf-8")
        port_line = next(line for line in text.splitlines() if line.startswith("port ="))
        robot_file.write_text(text.replace(port_line, f'port = "{sim.ports["neck"]}"'), encoding="utf-8")
        first = run("-m", "trade_gateway", "up", robot_file, "--json")
        first.json()
        trade.find(where(name="enable", group="rosie.neck.pan"), wait_s=30)()
        first.signal(signal.SIGKILL)
        wait_until(lambda: bool(events(sim.entries(), "watchdog_expired")))
        first.wait()
        second = run("-m", "trade_gateway", "up", robot_file)
        while "its watchdog stopped it" not in (line := second.line()):
            pass
        assert re.fullmatch(r"\d\d:\d\d:\d\d rosie\.neck\.pan: .* trade call rosie\.neck\.pan\.enable\n", line)
        second.close()


def test_what_a_killed_simulation_left_is_removed_by_the_next(run, system: str) -> None:
    words = ("-m", "trade_gateway", "up", ROSIES_HEAD, "--sim", "--json")
    first = run(*words)
    folder = Path(first.json()["control"]).parent
    first.signal(signal.SIGKILL)
    first.wait()
    assert folder.exists()
    second = run(*words)
    second.json()
    assert not folder.exists()


def test_the_path_of_the_simulators_socket_and_that_nothing_is_wrong_are_said(run, system: str) -> None:
    up = run("-m", "trade_gateway", "up", ROSIES_HEAD, "--sim")
    while "to inject faults into the simulator" not in (line := up.line()):
        pass
    program, *words = line.split(": ")[1].partition(" FAULT")[0].split()
    assert program == "trade-hil-sim"
    command = [sys.executable, "-m", "trade_hil_sim", *words, "state"]
    reported = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True).stdout
    assert [device["joint"] for device in json.loads(reported)["devices"]] == ["neck.pan", "neck.tilt"]
    assert up.line() == "Ctrl-C leaves\n"
    assert re.fullmatch(r"\d\d:\d\d:\d\d no joint has a fault\n", up.line())


def test_each_bus_is_announced_with_its_devices(run, system: str, tmp_path: Path) -> None:
    hand = (ROOT / "examples" / "hand.toml").read_text()
    spare = '[bus.spare]\ndriver = "dynamixel"\nport = "/dev/ttyUSB7"\n'
    (tmp_path / "rosie.toml").write_text(hand + spare)
    up = run("-m", "trade_gateway", "up", tmp_path / "rosie.toml", "--sim")
    assert up.line().endswith("/hand: left.hand (2F-85, id 9)\n")
    assert up.line().endswith('/spare: no device; a device on it has bus = "spare"\n')


def test_help_names_every_command(trade_command: Command) -> None:
    shown = trade_command("--help").stdout
    assert all(command in shown for command in ("up", "services", "call", "containers"))


def test_an_empty_system_says_how_to_start_a_robot(trade_command: Command) -> None:
    assert "trade up examples/rosie.toml --sim" in trade_command("services").stdout


def test_a_missing_robot_file_is_named(trade_command: Command) -> None:
    started = trade_command("up", "nowhere.toml", "--sim")
    assert started.returncode == 1
    assert "nowhere.toml" in started.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_S19_shutdown_holds_the_position_and_moves_nothing(number: int, rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    # Simulated servos are silent while their threads get no processor; the way here is not what is judged.
    wait_until(lambda: trade_command("call", "rosie.head.move_to", "[0.3, -0.2]").returncode == 0)
    log = rosie.log
    before = len(events(read_log(log), "motion_started"))
    rosie.program.signal(number)
    assert rosie.program.wait() == 0, rosie.program.errors
    entries = read_log(log)
    assert len(events(entries, "motion_started")) == before
    assert events(entries, "torque_off") == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_S05_a_call_that_is_interrupted_killed_or_loses_its_terminal_stops_the_motion(
    number: int, rosie_up, run
) -> None:
    rosie = rosie_up()
    words = ("call", "rosie.head.move_to", "[1.2, 0.0]", "speed_rad_s=0.05", "--deadline", "60")
    call = run("-m", "trade_gateway", *words)
    wait_until(lambda: bool(events(read_log(rosie.log), "motion_started")))
    call.signal(number)
    assert call.wait() == 130
    [rest] = [entry for entry in events(read_log(rosie.log), "at_rest") if entry.joint == "neck.pan"]
    assert rest.position_rad is not None
    assert rest.position_rad < 1.0


def test_a_robot_of_a_name_that_is_up_is_refused(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    second = trade_command("up", ROSIES_HEAD, "--sim")
    assert second.returncode == 1
    assert f"'rosie' is up already (process {rosie.program.process.pid}" in second.stderr


def test_a_mistake_only_the_simulator_sees_is_one_line(trade_command: Command, tmp_path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text(ROSIES_HEAD.read_text(encoding="utf-8").replace("XL430-W250", "XL430-W25"), encoding="utf-8")
    started = trade_command("up", broken, "--sim")
    assert started.returncode == 1
    assert "ConfigurationError" in started.stderr
    assert "Traceback" not in started.stderr
    assert "'XL430-W25'" in started.stderr


def test_documented_services_keep_their_types(rosie_up, trade_command: Command) -> None:
    rosie_up()
    assert "positions_rad: list[float]" in trade_command("services", "--group", "rosie.head", "--doc").stdout


def test_devices_left_out_of_a_robot_are_named_and_not_looked_for(run, trade_command: Command) -> None:
    rosie = ROOT / "examples" / "rosie.toml"
    out = [word for part in ("left_arm", "hand", "right_arm", "legs") for word in ("--without", part)]
    up = run("-m", "trade_gateway", "up", rosie, "--sim", *out)
    assert "left out: right.shoulder.pan, " in (said := up.line())
    assert said.endswith(", left.hand, left.arm, right.arm, legs\n")
    while up.line() != "Ctrl-C leaves\n":
        pass
    listed = json.loads(trade_command("services", "--group", "rosie", "--json").stdout)
    stayed = ("neck.pan", "neck.tilt", "head", "tail.root", "tail.tip", "tail", "bus.tail", "faults")
    assert {group for each in listed for group in each["groups"]} == {f"rosie.{name}" for name in stayed}
    nothing = trade_command("up", rosie, *out, "--without", "neck", "--without", "tail")
    assert "nothing would be left" in nothing.stderr
