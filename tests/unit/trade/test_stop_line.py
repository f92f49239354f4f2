"""The stop line: who is heard on it, what is done, what is answered, and that strangers do not fill it."""

import contextlib
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from trade import Container, Settings, service, where
from trade._audit.events import Event
from trade._estop.broadcast import EstopReport, all_of
from trade._paths import runtime_folder
from trade.protocol.messages import Malformed
from trade.stop_line import StopLines, StopReport
from trade.stop_line.group_stop import merge_reports
from trade.stop_line.listener import MOST_STRANGERS
from trade.stop_line.messages import MOST_BYTES, StopAnswer, StopRequest, encoded, read_answer, read_request
from trade.stop_line.places import Place, line_port, places
from trade.transport.endpoints import Endpoint
from trade.transport.host_socket import listen_on_host

StartContainer = Callable[..., Container]


class Lamp:
    """It can be stopped."""

    def __init__(self, problem: str = "") -> None:
        self.stops = 0
        self.problem = problem

    @service
    def on(self) -> None:
        """Shine."""

    @service(effect="stop")
    def stop(self) -> None:
        """End that."""
        self.stops += 1
        if self.problem:
            raise RuntimeError(self.problem)


@pytest.fixture
def lamp() -> Lamp:
    return Lamp()


@pytest.fixture
def driver(start_container: StartContainer, lamp: Lamp) -> Container:
    container = start_container("driver")
    container.register(lamp, groups=["rosie.lamp"])
    return container


def lines(container: Container) -> StopLines:
    """Those of a client of the same system that has no link to it."""
    return StopLines(Settings.read(system=container.settings.system, container="panel", identity="anna"))


def stop_socket(container: Container) -> Path:
    [place] = places(container.settings)
    assert place.path is not None
    return place.path


def dial(container: Container) -> socket.socket:
    [place] = places(container.settings)
    return place.connect(5)


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def asked(container: Container, line: bytes) -> list[dict[str, object]]:
    with dial(container) as sock:
        sock.sendall(line)
        heard = b""
        while more := sock.recv(65536):
            heard += more
    return [json.loads(one) for one in heard.splitlines()]


# --- what is done


def test_a_group_is_stopped_without_a_link(driver: Container, lamp: Lamp) -> None:
    report = lines(driver).stop("rosie", "smoke", 5).wait()
    assert report == StopReport("rosie", ("rosie.lamp.stop",))
    assert report.complete
    assert lamp.stops == 1


def test_an_estop_is_opened_without_a_link_and_names_who_asked(driver: Container, lamp: Lamp) -> None:
    rows: list[Event] = []
    driver._parts.audit._tell = rows.append
    report = lines(driver).estop("1234abcd", "smoke", 5).wait()
    assert [row.who for row in rows if row.what == "stop line"] == ["anna"]
    assert report == EstopReport("1234abcd", (driver.address.who,))
    assert lamp.stops == 1
    [estop] = driver.estops()
    assert (estop.id, estop.reason) == ("1234abcd", "smoke (asked by anna/panel on the stop line)")
    assert driver.estop_clear([estop.id]).complete


def test_no_stop_is_refused_for_the_length_of_its_reason(driver: Container, lamp: Lamp) -> None:
    """What a request may be is bounded in bytes, and in characters."""
    reason = "\N{PILE OF POO}" * 2000
    assert lines(driver).stop("rosie", reason, 5).wait().complete
    assert lines(driver).estop("1234abcd", reason, 5).wait().complete
    assert lamp.stops == 2
    assert driver.estop_clear(["1234abcd"]).complete


@pytest.mark.realtime
def test_what_is_asked_of_many_is_one_estop(driver: Container, start_container: StartContainer, lamp: Lamp) -> None:
    others = [start_container(f"arm{number}") for number in range(6)]
    for other in others:
        other.register(Lamp(), groups=[f"rosie.{other.name}"])
    report = lines(driver).estop("1234abcd", "", 10).wait()
    assert report.complete
    assert set(report.confirmed) >= {container.address.who for container in (driver, *others)}
    for container in (driver, *others):
        assert [estop.id for estop in container.estops()] == ["1234abcd"]


def test_a_failed_stop_is_reported_with_its_reason(start_container: StartContainer) -> None:
    container = start_container("driver")
    container.register(Lamp("it is stuck"), groups=["rosie.lamp"])
    report = lines(container).stop("rosie.lamp", "", 5).wait()
    assert not report.complete
    assert "it is stuck" in report.failed["rosie.lamp.stop"]


def test_nothing_to_stop_is_not_complete(driver: Container, lamp: Lamp) -> None:
    assert lines(driver).stop("dora", "", 5).wait() == StopReport("dora")
    assert not lines(driver).stop("dora", "", 5).wait().complete
    assert lamp.stops == 0


def test_a_container_stops_a_group_it_is_linked_to(
    driver: Container, start_container: StartContainer, lamp: Lamp
) -> None:
    client = start_container("client")
    assert client.stop("rosie.lamp", "enough").stopped == ("rosie.lamp.stop",)
    assert lamp.stops >= 1


def test_open_estops_can_be_listed(driver: Container) -> None:
    assert driver.estop("smoke").complete
    [answer] = asked(driver, b'{"v":1,"ask":"open"}\n')
    assert [estop["reason"] for estop in answer["open"]] == ["smoke"]  # type: ignore[attr-defined]


# --- who may


def test_the_socket_is_for_this_user_and_goes_with_its_container(driver: Container) -> None:
    path = stop_socket(driver)
    assert path.stat().st_mode & 0o077 == 0
    driver.close()
    assert not path.exists()


def test_the_socket_of_a_killed_container_is_removed(driver: Container) -> None:
    opened = listen_on_host(driver.settings.system, ".stop-")
    assert opened is not None
    server, left = opened
    server.close()
    assert left.exists()
    assert [place.path for place in places(driver.settings)] == [stop_socket(driver)]
    assert not left.exists()


@pytest.mark.parametrize("process", ["4194400", "1"], ids=["of no process here", "of another one"])
def test_the_socket_of_a_living_container_stays_whatever_its_process_id_means_here(
    driver: Container, process: str, lamp: Lamp
) -> None:
    """A client in another process namespace, as in another container with the same folder, does not know the id."""
    path = stop_socket(driver)
    elsewhere = path.rename(path.with_name(f".stop-{process}-{path.name[-8:]}"))
    assert [place.path for place in places(driver.settings)] == [elsewhere]
    assert lines(driver).stop("rosie", "", 3).wait().complete
    assert lamp.stops == 1


def test_a_stop_line_that_vanished_is_back_within_a_beat(
    driver: Container, lamp: Lamp, caplog: pytest.LogCaptureFixture
) -> None:
    """A session manager empties the folder at the last logout, for example."""
    before = set(threading.enumerate())
    assert not lines(driver).stop("rosie", "", 0.1).problems  # control
    shutil.rmtree(runtime_folder())
    assert places(driver.settings) == []
    wait_until(lambda: bool(places(driver.settings)), "it listens again")
    wait_until(lambda: len(set(threading.enumerate()) - before) <= 1, "its old thread has ended")
    assert sum("has vanished, and is made again" in text for text in caplog.messages) == 1
    lamp.stops = 0
    assert lines(driver).stop("rosie", "", 3).wait().complete
    assert lamp.stops == 1


def test_after_the_folder_was_emptied_a_new_program_finds_the_robot_and_has_its_secret(
    driver: Container, start_container: StartContainer
) -> None:
    secret = (runtime_folder() / "@secret").read_bytes()
    shutil.rmtree(runtime_folder())
    wait_until((runtime_folder() / "@secret").exists, "its files are back")
    wait_until(lambda: bool(places(driver.settings)), "it listens again")
    assert (runtime_folder() / "@secret").read_bytes() == secret
    assert start_container("late").find(where(name="on"), wait_s=10) is not None


@pytest.mark.parametrize("name", ["tom@oldname", "user{uid}-local", "user{uid}-ffffffff", "lab"])
def test_a_stop_in_the_default_system_also_reaches_robots_that_run_under_an_earlier_name(
    name: str, system: str, lamp: Lamp, tmp_path: Path
) -> None:
    """As after an upgrade, or when the host got its machine id late. An explicit system is another one: the control."""
    default = Settings.read(container="panel", environment={"TRADE_STATE_DIR": str(tmp_path)})
    earlier = Settings.read(system=name.format(uid=os.getuid()), container="robot")
    with Container(earlier) as robot:
        robot.register(lamp, groups=["rosie.lamp"])
        report = StopLines(default).estop("abc", "smoke", 3).wait()
        assert report.confirmed == (() if name == "lab" else (robot.address.who,))
        assert lamp.stops == (name != "lab")


def test_a_container_with_nothing_to_stop_does_not_listen(start_container: StartContainer) -> None:
    assert places(start_container("mind").settings) == []


def test_a_revoked_identity_stops_nothing(start_container: StartContainer, tmp_path: Path, lamp: Lamp) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('revoked = ["anna"]\n[identities]\nberta = ["all"]\n[roles.all]\nregister = ["*"]\n')
    container = start_container("driver")
    container.register(lamp, groups=["rosie.lamp"])
    container.load_policy(policy)
    for ask in ("stop", "estop"):
        line = encoded(StopRequest(v=1, ask=ask, by="anna/panel", group="rosie", id="12"))  # type: ignore[arg-type]
        [answer] = asked(container, line)
        assert answer["error"] == "AccessDenied"
    assert lamp.stops == 0
    assert container.estops() == []


# --- what is no request


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"{}",
        b"[]",
        b"\xff\xfe",
        b"[" * 4000,
        b'{"v":1,"ask":"dance"}',
        b'{"v":0,"ask":"open"}',
        b'{"v":1,"ask":"estop"}',
        b'{"v":1,"ask":"estop","id":"a/b"}',
        b'{"v":1,"ask":"stop"}',
        b'{"v":1,"ask":"stop","group":"*"}',
        b'{"v":1,"ask":"stop","group":"a","limit_s":1e999}',
        b'{"v":1,"ask":"stop","group":"a","limit_s":0}',
        b'{"v":1,"ask":"stop","group":"a","by":"a/b/c"}',
    ],
)
def test_what_is_no_request_is_refused_and_stops_nothing(driver: Container, lamp: Lamp, line: bytes) -> None:
    [answer] = asked(driver, line + b"\n")
    assert answer["error"] == "Malformed"
    assert lamp.stops == 0
    assert driver.estops() == []


def test_a_line_without_an_end_is_dropped(driver: Container) -> None:
    with dial(driver) as sock:
        sock.sendall(b"x" * (MOST_BYTES + 1))
        sock.settimeout(30)
        with contextlib.suppress(ConnectionResetError):
            assert sock.recv(1) == b""


def test_messages_of_a_later_version_are_read() -> None:
    request = read_request(b'{"v":7,"ask":"open","more":[1]}')
    assert (request.v, request.ask) == (7, "open")
    assert read_answer(encoded(StopAnswer(who="a/b", taken=True))) == StopAnswer(who="a/b", taken=True)
    with pytest.raises(Malformed):
        read_answer(b"nothing")


def test_the_port_is_a_thousand_above_or_below() -> None:
    assert (line_port(7450), line_port(65000)) == (8450, 64000)


# --- reports of several


def test_a_container_that_confirmed_once_is_not_missing() -> None:
    first = EstopReport("1", ("a/a",), missing=("b/b", "c/c"))
    second = EstopReport("1", ("b/b",), failed={"d/d": "it is stuck"})
    assert all_of("1", [first, second]) == EstopReport("1", ("a/a", "b/b"), ("c/c",), {"d/d": "it is stuck"})


def test_a_container_that_failed_for_one_has_not_confirmed() -> None:
    first, second = EstopReport("1", ("a/a",)), EstopReport("1", (), failed={"a/a": "it is stuck"})
    assert not all_of("1", [first, second]).complete


def test_what_one_container_stopped_counts_as_stopped() -> None:
    reports = [StopReport("a", ("a.stop",)), StopReport("a", (), {"a.stop": "ServiceGone", "b.stop": "stuck"})]
    assert merge_reports("a", reports) == StopReport("a", ("a.stop",), {"b.stop": "stuck"})


# --- strangers


@pytest.fixture
def strangers() -> Iterator[list[socket.socket]]:
    crowd: list[socket.socket] = []
    yield crowd
    for one in crowd:
        one.close()


def test_silent_strangers_shut_no_client_out_and_are_dropped(
    driver: Container, lamp: Lamp, strangers: list[socket.socket]
) -> None:
    files = open_files()
    for _ in range(3 * MOST_STRANGERS):
        strangers.append(dial(driver))
    wait_until(lambda: open_files() - files <= 3 * MOST_STRANGERS + MOST_STRANGERS)
    assert lines(driver).stop("rosie", "", 10).wait().complete
    assert lamp.stops == 1
    wait_until(lambda: open_files() - files <= 3 * MOST_STRANGERS)  # their own ends alone


def test_requests_of_one_identity_are_bounded_and_others_are_heard(start_container: StartContainer) -> None:
    hold = threading.Event()

    class Slow:
        @service
        def go(self) -> None:
            """Go."""

        @service(effect="stop")
        def stop(self) -> None:
            """Take long."""
            hold.wait(60)

    container = start_container("driver")
    container.register(Slow(), groups=["rosie.slow"])
    line = encoded(StopRequest(v=1, ask="stop", by="anna/panel", group="rosie.slow", limit_s=60))
    crowd = [dial(container) for _ in range(8)]
    try:
        for sock in crowd:
            sock.sendall(line)
        for sock in crowd:
            sock.settimeout(60)
            assert b"taken" in sock.recv(4096)
        [refused] = asked(container, line)
        assert refused["error"] == "LimitExceeded"
        assert asked(container, b'{"v":1,"ask":"open","by":"berta/panel"}\n')[0]["open"] == []
    finally:
        hold.set()
        for sock in crowd:
            sock.close()
    wait_until(lambda: "error" not in asked(container, b'{"v":1,"ask":"open","by":"anna/panel"}\n')[0])


def test_a_stranger_has_a_second(driver: Container) -> None:
    with dial(driver) as sock:
        sock.sendall(b'{"v":1,')
        sock.settimeout(60)
        began = time.monotonic()
        assert sock.recv(1) == b""
        assert time.monotonic() - began >= 0.5  # not at once: who is slow is no flood


# --- when a report is enough


@pytest.fixture
def dead() -> Iterator[Place]:
    """A place on a network where nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    yield Place(f"tls/127.0.0.1:{port - 1000}", endpoint=Endpoint("tls", "127.0.0.1", port - 1000))


@pytest.mark.parametrize("ask", ["stop", "estop"])
def test_a_dead_endpoint_keeps_no_report_waiting(
    driver: Container, lamp: Lamp, dead: Place, ask: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = [*places(driver.settings), dead]
    monkeypatch.setattr("trade.stop_line.client.places", lambda _: known)
    line = lines(driver)
    asked = line.stop("rosie", "", 60) if ask == "stop" else line.estop("abc", "", 60)
    assert asked.wait_enough().complete
    assert asked.is_enough()
    assert asked.unreached() == [dead.name]
    assert lamp.stops >= 1


def test_a_place_that_accepts_and_does_not_answer_is_waited_for(
    driver: Container, dead: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a robot in a flood, or frozen: the others' confirmations do not speak for it."""
    assert dead.endpoint is not None
    known = [*places(driver.settings), dead]
    monkeypatch.setattr("trade.stop_line.client.places", lambda _: known)
    with socket.create_server(("127.0.0.1", line_port(dead.endpoint.port))):
        asked = lines(driver).estop("abc", "", 1.5)
        assert asked.wait_enough().complete  # what is confirmed, is confirmed
        assert not asked.is_enough()
        assert asked.is_done() or asked.wait().complete
        assert dead.name not in asked.unreached()


def test_a_place_that_refuses_the_request_makes_no_report_enough(
    driver: Container, lamp: Lamp, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = [*places(driver.settings), Place(".stop-1-gone", path=runtime_folder() / ".stop-1-gone")]
    monkeypatch.setattr("trade.stop_line.client.places", lambda _: known)
    asked = lines(driver).estop("abc", "", 3)
    assert asked.wait_enough().complete
    assert not asked.is_enough()


def test_endpoints_without_a_stop_line_are_reported_by_whether_they_answer(driver: Container, dead: Place) -> None:
    assert dead.endpoint is not None
    gone = f"tcp/127.0.0.1:{dead.endpoint.port}"
    with socket.create_server(("127.0.0.1", 0)) as listening:
        there = f"tcp/127.0.0.1:{listening.getsockname()[1]}"
        settings = Settings.read(system=driver.settings.system, container="panel", connect=[there, gone])
        assert StopLines(settings).without_line() == {there: True, gone: False}
