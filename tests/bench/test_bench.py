"""The bench runs and prints its lines; how fast anything is, is not this test's business."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

import tests.bench.__main__ as bench_main
from tests.bench._calls import up
from tests.bench._children import Job
from tests.bench._flood import FLOODS
from tests.bench._messages import BareMessages
from tests.bench._others import Grpc, Pyro5, Rpyc
from tests.bench._record import Run
from tests.bench._report import print_target, this_run
from tests.bench._ros1 import Rospy
from tests.bench._scale import measure
from tests.bench._viam import Viam
from tests.support.ros1_system import need_ros1
from tests.system.networks import why_not

ROOT = Path(__file__).parents[2]


def targets(printed: str) -> list[str]:
    return [re.split("  | [0-9]+[.]", line)[0] for line in printed.splitlines() if "  target " in line]


def bench(*arguments: str, timeout_s: float = 100) -> str:
    command = [sys.executable, "-m", "tests.bench", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_of(parts: dict[str, Callable[[object], None]], folder: Path) -> tuple[int, Run]:
    """The exit code of a bench with these parts alone, and what it wrote."""
    this_run.cache_clear()
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", ["bench", "--json", str(folder / "run.json")])
        patch.setattr(bench_main, "_PARTS", parts)
        bench_main.main()
    this_run.cache_clear()
    return int(ended.value.code or 0), Run.read(folder / "run.json")


def succeed(_: object) -> None:
    print_target("quick", [1.0], "at most 2", lambda x: x <= 2)


def test_a_part_that_fails_twice_is_reported_and_the_others_continue(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        print_target("half done", [1.0], "at most 2", lambda x: x <= 2)
        raise RuntimeError("no such bus")

    code, run = run_of({"servo": fail, "local": succeed}, tmp_path)
    assert code == 1
    assert [(one.part, one.name, one.reason) for one in run.skipped] == [
        ("servo", "servo", "it failed: RuntimeError: no such bus")
    ]
    assert [(one.part, one.name, one.met) for one in run.targets] == [("local", "quick", True)]
    assert "all targets: 1 met, 0 missed" in capsys.readouterr().out


def test_a_part_that_fails_once_is_measured_again(tmp_path: Path) -> None:
    attempts = iter((True, False))

    def fail_first(_: object) -> None:
        succeed(_)
        if next(attempts):
            raise RuntimeError("a servo did not answer")

    code, run = run_of({"servo": fail_first}, tmp_path)
    assert code == 0
    assert [one.name for one in run.targets] == ["quick"]
    assert run.skipped == []


PEERS = ("raw TCP", "bare zenoh pair", "bare zenoh query", "TRADE ", "rpyc", "Pyro5", "gRPC")
SIZES = ("64 B", "4 KiB", "64 KiB", "2 MiB")


def test_the_bench_of_calls_prints_every_peer_and_every_target() -> None:
    printed = bench("calls", "-n", "3", "--rounds", "1")
    for peer in (*PEERS, "TRADE, local"):
        assert printed.count(f"\n{peer}") == len(SIZES) + 1  # and small ones on one processor
    each = ("p50 / bare pair", "CPU / bare pair", "p50 / rpyc")
    others = [peer.name for peer in (Rpyc(), Grpc(), Viam()) if not peer.missing]
    small = (*each[:2], *(f"p50 / {other}" for other in others), "p99 / p50, over raw TCP's")
    of_size = {"64 B": small, "4 KiB": each, "64 KiB": each, "2 MiB": ("p50 / bare copies", "p50 / rpyc")}
    on_one = [f"64 B, one processor: p50 / {peer.name}" for peer in (BareMessages(), Pyro5()) if not peer.missing]
    assert targets(printed) == [*(f"{size}: {what}" for size in SIZES for what in of_size[size]), *on_one]


def test_the_bench_of_calls_in_flight_prints_every_peer_and_every_target() -> None:
    printed = bench("in-flight", "-n", "3", "--rounds", "1")
    for peer in (*PEERS, "TRADE, threads"):
        assert len(re.findall(rf"^{peer}[^:]*$", printed, re.MULTILINE)) == len(SIZES)
    floors = {size: "bare messages, threads" if size == "64 KiB" else "bare pair" for size in SIZES}
    shares = [
        share
        for size, floor in floors.items()
        for share in (f"{size}, TRADE: rate / {floor}", f"{size}, TRADE, threads: rate / bare messages, threads")
    ]
    assert targets(printed) == [*shares[:2], "64 B, 32 in flight: /s", *shares[2:]]


def test_the_bench_of_checks_prints_each_thing_that_may_be_added_to_a_call() -> None:
    printed = bench("checks", "-n", "3", "--rounds", "1")
    for kind in ("lock held", "hooks: 1 ", "hooks: 10", "TLS and policy"):
        assert len(re.findall(rf"^TRADE, {kind} .*[1-9].*x$", printed, re.MULTILINE)) == 1
    assert len(re.findall(r"takes +[0-9.]+ x the p50", printed)) == 5


def test_the_bench_of_the_supervisor_prints_its_targets() -> None:
    printed = bench("supervisor", "--rounds", "1", "--idle", "1")
    assert targets(printed) == [
        "supervisor: % of a core",
        "crash to serving, s",
        "crash to serving / plain start",
        "one bus: to service, s",
        "one bus: RSS, MiB",
    ]


def test_a_peer_that_is_not_installed_is_named_and_skipped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Rpyc, "needs", "no_such_module")
    with up([Rpyc()]) as peers:
        assert peers == []
    assert capsys.readouterr().out == "rpyc: skipped, the module no_such_module is not installed\n"


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's figures of threads are Linux's")
def test_what_each_thread_of_a_call_takes_is_printed_for_both_ends() -> None:
    command = [sys.executable, "-m", "tests.bench.threads", "-n", "50"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=True).stdout
    for peer in ("bare zenoh pair", "TRADE", "TRADE, threads"):
        [block] = re.findall(rf"^{peer}: 50 calls.*\n((?:  .*\n)+)", printed, re.MULTILINE)
        assert {"server", "caller"} == {line.split()[0] for line in block.splitlines()}
        assert "python, main" in block


def test_rospy_answers_under_the_Python_that_it_is_installed_for_and_its_master_ends_with_it() -> None:
    need_ros1()
    with up([Rospy()]) as [rospy]:
        alone, many = rospy.run(Job(64, 5)), rospy.run(Job(4096, 40, in_flight=4))
        [master] = [one for one in psutil.Process().children(recursive=True) if "/usr/bin/rosmaster" in one.cmdline()]
    assert not master.is_running()
    assert alone.p50_us > 0
    assert many.calls_per_s > 0
    assert many.cpu_us > 0


def test_the_Viam_SDK_answers_in_an_environment_of_its_own() -> None:
    if why := Viam().missing:
        pytest.skip(why)
    with up([Viam()]) as [viam]:
        alone, many = viam.run(Job(64, 5)), viam.run(Job(4096, 40, in_flight=4))
    assert alone.p50_us > 0
    assert many.calls_per_s > 0


def test_the_bench_of_local_calls_prints_its_targets_and_writes_them_with_its_points(tmp_path: Path) -> None:
    printed = bench("local", "-n", "3", "--rounds", "2", "--json", str(tmp_path / "run.json"))
    assert targets(printed) == [
        "local, strict: us a call",
        "local, not strict / bare context",
        "local: attribute / handle",
    ]
    run = Run.read(tmp_path / "run.json")
    assert [target.name for target in run.targets] == targets(printed)
    assert [(point.part, point.name) for point in run.points] == [
        ("local", name) for name in ("plain method", "bare context", "strict", "strict=False", "strict, attribute")
    ]
    assert all(point.n == 2 * 50 * 3 and point.values["us"].rounds == 2 for point in run.points)
    assert run.took_s is not None
    assert run.arguments == ["local", "-n", "3", "--rounds", "2"]


def test_the_bench_of_the_registry_prints_its_targets() -> None:
    printed = bench("registry", "--services", "30", "--rounds", "1")
    assert targets(printed) == ["late joiner: s", "remote service: KiB", "find: us"]
    assert "missed up to" not in printed


def test_the_bench_of_locks_prints_its_targets() -> None:
    assert targets(bench("locks", "-n", "3", "--rounds", "1")) == [
        "lock and unlock / call on the transport",
        "checked / unchecked call",
    ]


def test_the_bench_of_the_can_bus_prints_its_targets() -> None:
    printed = bench("can", "--rounds", "1", "--seconds", "0.5")
    assert targets(printed) == ["late at 500 Hz, 1 TPDO, %", "late at 400 Hz, 2 TPDO, %"]
    assert printed.count("late in an empty loop") == 2


def test_the_bench_of_a_whole_robot_prints_its_target() -> None:
    printed = bench("rosie", "--rounds", "2", "--seconds", "0.5")
    assert "legs 200 Hz" in printed
    lost = "; 0 of 1 rounds" in printed  # too busy a machine loses devices
    assert targets(printed) == ([] if lost else ["all drivers: % of a core"])


def test_the_bench_of_watching_prints_its_targets() -> None:
    printed = bench("watching", "-n", "3", "--rounds", "1", "--seconds", "0.3")
    assert targets(printed) == ["merged ticks, %", "another watched / none"]


def test_the_bench_of_audit_records_prints_its_targets() -> None:
    printed = bench("audit", "-n", "3", "--rounds", "1", "--seconds", "0.3")
    assert targets(printed) == ["p50: audit on / off", "p99: with records / without", "records/s written"]


def test_the_bench_of_streams_prints_its_target() -> None:
    assert targets(bench("streams", "--rounds", "1", "--seconds", "0.1")) == ["five listeners / one"]


def test_the_bench_of_the_servo_bus_prints_its_targets() -> None:
    printed = bench("servo", "-n", "3", "--rounds", "1", "--seconds", "0.05")
    assert "156 bytes a cycle" in printed
    assert "190 bytes a cycle" in printed
    assert targets(printed) == ["fast sync / limit", "CPU at 100 Hz, fast", "CPU at 100 Hz, plain"]


def test_the_bench_of_the_Feetech_bus_prints_its_targets() -> None:
    printed = bench("feetech", "-n", "3", "--rounds", "1", "--seconds", "0.05")
    assert "142 bytes a cycle" in printed
    assert targets(printed) == ["Feetech sync / limit", "CPU at 100 Hz, Feetech"]


def test_the_bench_of_arms_prints_its_targets() -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
    printed = bench("arm", "--rounds", "1", "--seconds", "0.5")
    assert targets(printed) == ["set-points/s, driver"]


@pytest.mark.timeout(300)
def test_the_bench_of_gateways_prints_every_pair_every_flood_and_every_target() -> None:
    if reason := why_not():
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)
    printed = bench("gateway", "-n", "3", "--rounds", "1", "--idle", "0.5", timeout_s=250)
    assert targets(printed) == [
        "idle gateway: RSS, MiB",
        "idle gateway: % of a core",
        *(
            f"{flood.name}: {what}"
            for flood in FLOODS
            for what in ("call p99, ms" if flood.kind == "stop" else "call p99 / none", "stop, ms")
        ),
        "one gateway: p50 / direct",
        "one gateway: p50 / bare messages",
        "one, plain: p50 / bare messages, plain",
        "two gateways: p50 / direct",
        "one gateway, 32 in flight: /s",
    ]
    assert re.search(r"\d+ services known across it", printed)
    for flood in FLOODS:
        assert len(re.findall(rf"^{flood.name} .*[1-9]", printed, re.MULTILINE)) == 1


def test_the_bench_of_the_deadman_prints_every_way_to_end() -> None:
    printed = bench("deadman", "--rounds", "1")
    assert targets(printed) == ["killed in a call", "killed in a start", "frozen in a call", "frozen in a jog"]


def test_the_bench_of_many_containers_prints_its_targets() -> None:
    printed = bench("scale", "--containers", "4", "--idle", "0.2")
    ours = [
        "join, bytes each: 4 / 4",
        "remote service: KiB of Python",
        "find: most / least",
        "lock: most / least",
    ]
    processes = [] if "processes: skipped" in printed else ["join, bytes: real / simulated"]
    assert targets(printed) == [*ours, *processes]


def test_the_bench_of_containers_behind_a_hub_prints_its_targets() -> None:
    printed = bench("hub", "--containers", "4", "--idle", "0.2")
    if "behind a hub: skipped" not in printed:
        assert targets(printed) == ["behind a hub: % of a core, each", "behind a hub: a join, s"]
        assert re.search(r"^  the hub +\d+ open files$", printed, re.MULTILINE)


def test_a_stand_in_costs_what_a_container_costs() -> None:
    """So what is counted of a thousand, most of them stand-ins, is what a thousand containers would cost."""
    whole, others = measure(6), measure(6, whole=2)
    assert (whole.whole, others.whole) == (6, 2)
    assert (whole.join, whole.leave, whole.register) == (others.join, others.leave, others.register)
    assert (whole.beat, whole.lock, whole.services) == (others.beat, others.lock, others.services)
