"""Changes of the system over HTTP: by the client's rights, and a refused one calls nothing."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.http_clients import Opened, govern, opened
from tests.support.policies import EVERYTHING, policy_text
from tests.support.two_joint_robot import Robot
from tests.support.waiting import wait_until
from tests.unit.gateway.moved_counter import Counter
from trade import HookEvent, service, where
from trade._audit.events import Event
from trade.testing import memory_system
from trade_gateway.supervisor import ChildInfo

pytestmark = pytest.mark.virtual_time

POLICY = policy_text(
    "bert=guest tester=all olga=operator vera=viewer",
    all=EVERYTHING,
    operator="read=* administer=trade,hall",
    viewer="read=*",
    guest="read=robot.a",
)


class Children:
    """A supervisor of one child, `worker`, of which only the requests are kept."""

    def __init__(self) -> None:
        self.restarted: list[str] = []
        self.stopped: list[str] = []

    @service(effect="read")
    def children(self) -> list[ChildInfo]:
        return [ChildInfo("worker", "up", 1, 0, ""), ChildInfo("lost", "given up", 0, 3, "it ended at once")]

    @service
    def restart_child(self, name: str) -> None:
        self.restarted.append(name)

    @service
    def stop_child(self, name: str) -> None:
        self.stopped.append(name)


class Watch:
    """What a hook calls."""

    @service
    def saw(self, event: HookEvent) -> None: ...


COUNTER = f"{Counter.__module__}:Counter"


class House:
    """An HTTP gateway, a supervising gateway, a `worker` with a counter, and a `spare` container."""

    def __init__(self, system: Any, made: Opened) -> None:
        self.opened = made
        self.me, self.gateway, self.worker = made.robot.me, system.container("gate"), system.container("worker")
        self.spare = system.container("spare", instantiable=[COUNTER])
        self.children = Children()
        self.gateway.register_functions(self.children, "supervisor")
        self.counter = Counter(7)
        self.worker.register(self.counter, "hall")
        count = self.worker.find(where(name="count"), wait_s=20)
        self.counted = self.worker.every(3600, count)
        [saw] = self.gateway.register(Watch(), "watch")
        self.gateway.after_service(self.gateway.find(where(name="count"), wait_s=20), saw)
        system.settle()

    def ask(self, who: str, method: str, path: str, body: Any = None) -> Any:
        return self.opened.client(who).ask(method, path, body)

    def places(self) -> list[str]:
        """Where counters are."""
        return [one.container for one in self.me.services(where(name="count", group="hall"))]


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    with memory_system() as system:
        robot = Robot(system, "a")
        with opened(robot.me, tmp_path) as (made, tokens):
            house = House(system, Opened(robot, made, tokens))
            govern(robot, tmp_path, POLICY)
            yield house


def requests_of(house: House) -> list[tuple[str, str, dict[str, Any] | None]]:
    """Every change that a client can request."""
    return [
        ("POST", "/containers/worker/restart", {}),
        ("POST", "/containers/worker/discovery", {"on": False}),
        ("POST", "/containers/worker/broadcast", {"on": False}),
        ("POST", "/migrate", {"group": "hall", "to": "spare"}),
        ("POST", "/instantiate", {"container": "spare", "class_path": COUNTER, "groups": ["hall"]}),
        ("POST", "/terminate", {"group": "hall"}),
        ("DELETE", f"/notifications/{house.counted.id}", None),
        ("DELETE", f"/hooks/{house.me.hooks()[0].id}", None),
        ("POST", "/containers/worker/end", {}),
    ]


def served(house: House) -> set[str]:
    """The middleware's services that were called and do more than read."""
    own = {span.service for span in house.me.spans() if span.side == "served" and span.service.startswith("trade.")}
    return own - {f"trade.{name}" for name in ("spans", "set_tracing", "hooks", "notifications", "children", "load")}


def test_a_viewer_is_refused_each_change_with_the_reason_and_nothing_is_called(house: House) -> None:
    asked = requests_of(house)
    house.me.set_tracing(True)
    for method, path, body in asked:
        refused = house.ask("vera", method, path, body)
        assert (refused.status, refused.title) == (403, "AccessDenied"), path
        assert refused.body["data"]["who"] == "vera"
        assert "no rule of role viewer allows administer in" in refused.body["detail"], path
    assert served(house) == set()
    assert (house.children.restarted, house.children.stopped, house.places()) == ([], [], ["worker"])
    assert [one.state for one in house.me.notifications()] == ["standing"]
    assert len(house.me.hooks()) == 1


def test_an_operator_restarts_moves_creates_and_ends(house: House) -> None:
    assert house.ask("olga", "POST", "/containers/worker/restart", {}).body == {"text": "gate starts worker again."}
    assert house.children.restarted == ["worker"]
    missing = house.ask("olga", "POST", "/containers/spare/restart", {})
    assert (missing.status, missing.title) == (404, "NoSuchService")
    moved = house.ask("olga", "POST", "/migrate", {"group": "hall", "to": "spare"})
    assert moved.body == {"text": "hall is in spare now."}
    assert house.places() == ["spare"]
    assert house.me.find(where(name="count", group="hall"), wait_s=20)() == 8  # with its state
    more = {"container": "spare", "class_path": COUNTER, "groups": ["hall.two"], "args": {"total": 40}}
    assert house.ask("olga", "POST", "/instantiate", more).body == {"text": "spare offers hall.two.count."}
    assert house.me.find(where(name="count", group="hall.two"), wait_s=20)() == 41
    both = house.ask("olga", "POST", "/terminate", {"group": "hall"})
    assert both.title == "TooManyServices"
    assert house.ask("olga", "POST", "/terminate", {"group": "hall.two"}).body == {"text": "hall.two ended in spare."}
    wait_until(lambda: house.places() == ["spare"])
    foreign = {"container": "spare", "class_path": "os:system", "args": {"command": "true"}}
    assert house.ask("olga", "POST", "/instantiate", foreign).title == "NotInstantiable"
    assert house.ask("olga", "POST", "/containers/worker/end", {}).body == {"text": "gate ends worker."}
    assert house.children.stopped == ["worker"]
    assert house.ask("olga", "POST", "/containers/spare/end", {}).body == {"text": "spare ends."}
    wait_until(lambda: not house.places())


def test_an_operator_ends_notifications_and_hooks_of_others(house: House) -> None:
    [hook] = house.me.hooks()
    assert house.ask("olga", "DELETE", f"/notifications/{house.counted.id}").status == 200
    assert house.ask("olga", "DELETE", f"/hooks/{hook.id}").status == 200
    assert (house.me.notifications(), house.me.hooks(), house.counted.active) == ([], [], False)
    again = house.ask("olga", "DELETE", f"/notifications/{house.counted.id}")
    assert (again.status, again.title) == (404, "NoSuchNotification")
    assert house.ask("olga", "DELETE", f"/hooks/{hook.id}").title == "NoSuchHook"


def test_a_switch_reaches_its_container(house: House) -> None:
    """Which has no links in memory, and says so; the browser's test has some."""
    for what in ("discovery", "broadcast"):
        refused = house.ask("olga", "POST", f"/containers/worker/{what}", {"on": True})
        assert (refused.status, refused.title) == (400, "ConfigurationError")
        assert "cannot change its links" in refused.body["detail"]


def test_a_provider_needs_the_right_over_its_own_groups(house: House) -> None:
    """Administering the system is not enough to move what belongs to others."""
    refused = house.ask("olga", "POST", "/migrate", {"group": "robot.a", "to": "spare"})
    assert (refused.status, refused.title) == (403, "AccessDenied")
    assert "administer in robot.a" in refused.body["detail"]
    assert {one.container for one in house.me.services(where(group="robot.a"))} == {"a"}


def test_the_system_is_shown_with_its_supervisor_to_readers_and_to_strangers_not_at_all(house: House) -> None:
    found = {one["name"]: one for one in house.ask("vera", "GET", "/system").body}
    assert set(found) == {"me", "other", "a", "gate", "worker", "spare", "lost"}
    worker, lost = found["worker"], found["lost"]
    assert (worker["services"], worker["actuating"], worker["groups"]) == (1, 1, ["hall"])
    assert (worker["supervised_by"], worker["state"]) == ("gate", "up")
    assert (lost["host"], lost["state"], lost["restarts"]) == ("", "given up", 3)
    assert (found["gate"]["supervises"], found["me"]["own"]) == (["worker", "lost"], True)
    assert house.ask("stranger", "GET", "/system").status == 403


def test_a_guest_learns_nothing_of_what_it_may_not_see(house: House) -> None:
    found = {one["name"]: one for one in house.ask("bert", "GET", "/system").body}
    assert (found["a"]["groups"], found["worker"]["groups"]) == (["robot.a"], [])
    assert "lost" not in found
    assert [one for one in found.values() if one["supervised_by"] or one["supervises"] or one["links"]] == []
    refused = house.ask("bert", "POST", "/migrate", {"group": "hall", "to": "spare"})
    assert (refused.status, refused.title) == (404, "NoSuchService")
    assert "hall" not in str(refused.body["data"]["groups"])
    assert house.places() == ["worker"]


def test_changes_are_on_record_with_their_client(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[Event] = []
    monkeypatch.setattr(house.me._parts.audit, "_tell", reported.append)
    house.ask("olga", "POST", "/containers/worker/restart", {"reason": "it hangs"})
    house.ask("olga", "POST", "/containers/nowhere/restart", {})
    house.ask("vera", "POST", "/containers/worker/restart", {})
    found = [
        (one.who, one.what, one.about, one.outcome) for one in reported if one.what in ("restart", "container worker")
    ]
    assert found == [
        ("olga", "restart", "worker", "ok"),
        ("olga", "restart", "nowhere", "NoSuchService"),
        ("vera", "container worker", "", "AccessDenied"),
    ]
