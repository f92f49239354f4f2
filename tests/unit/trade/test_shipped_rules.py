"""The rules of ``examples/rules.toml``, each at work in a system as it describes."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar

import pytest

from tests.support.waiting import wait_until
from trade import Container, service, where
from trade._calls import picking
from trade._migration import source as _departing
from trade.errors import NoSuchService, ServiceGone
from trade.rules import Firing, Rules, read_rules, rehearse
from trade.rules import _engine as rules_module
from trade.transport.endpoints import free_endpoint

pytestmark = pytest.mark.virtual_time

EXAMPLES = Path(__file__).parents[3] / "examples"
SHIPPED, CARE = EXAMPLES / "rules.toml", EXAMPLES / "care.toml"
StartContainer = Callable[..., Container]
Only = Callable[..., Rules]


class Camera:
    @service(effect="read", achieves=["see(?object)"])
    def check_for(self, object_type: str) -> bool:
        return object_type == "mug"


class Planner:
    made: ClassVar[list["Planner"]] = []
    load = 0.2

    def __init__(self) -> None:
        self.plans: list[str] = []
        self.made.append(self)

    @service(effect="read")
    def busy(self) -> float:
        return self.load

    @service(achieves=["plan(?goal)"])
    def plan(self, goal: str) -> str:
        self.plans.append(goal)
        threading.Event().wait(0.05)  # eight at once outweigh a busy processor
        return goal

    def save_state(self) -> float:
        return self.load

    def restore_state(self, state: float) -> None:
        self.load = state


@pytest.fixture
def only(here: Container, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Only]:
    """Runs one of the rules, as in the file but for how long it waits."""
    monkeypatch.setattr(rules_module, "LOOK_S", 0.02)
    begun: list[Rules] = []

    def begin(name: str, shipped: Path = SHIPPED, **instead: str) -> Rules:
        text = shipped.read_text(encoding="utf-8")
        [part] = [part for part in text.split("\n\n") if part.startswith(f"[rule.{name}]")]
        for old, new in instead.items():
            assert old in part
            part = part.replace(f"{old} = 10\n", f"{old} = {new}\n").replace(f"{old} = 10 ", f"{old} = {new} ")
        file = tmp_path / "rules.toml"
        file.write_text(part, encoding="utf-8")
        begun.append(Rules(here, file))
        return begun[-1]

    yield begin
    for rules in begun:
        rules.close()


def first(rules: Rules) -> Firing:
    wait_until(rules.rule_firings)
    return rules.rule_firings()[0]


def stand_by(container: Container, provider: object, group: str) -> None:
    """Registered once and withdrawn: anybody may have it offered by its name."""
    [handle, *_] = container.register(provider, group)
    container.system.deregister(handle)


def seers(looking: Container) -> list[str]:
    return [handle.container for handle in looking.services(where(name="check_for", group="rosie.eyes"))]


def test_the_file_is_right_and_is_rehearsed_in_an_empty_system(here: Container) -> None:
    reported = {rehearsal.rule: rehearsal.fires for rehearsal in rehearse(here, read_rules(SHIPPED))}
    assert reported == {
        "bootstrap": True,
        "elsewhere": True,
        "degraded": False,
        "balance": False,
        "ease": False,
        "relocate": False,
    }


@pytest.mark.realtime
def test_bootstrap_stays_discoverable_until_a_provider_that_can_see_has_joined(
    start_container: StartContainer, only: Only, here: Container
) -> None:
    at = free_endpoint()
    far = start_container("far", listen=[at], connect=[at])
    far.register(Camera(), "rosie.eyes")
    far.system.set_discovery(True)
    assert here.services(where(name="check_for")) == []
    firing = first(only("bootstrap"))
    assert firing.ok
    assert [did.service for did in firing.steps] == [
        "trade.set_broadcast",
        "rosie.eyes.check_for",
        "trade.set_broadcast",
    ]
    assert seers(here) == ["far"]
    at = free_endpoint()
    late = start_container("late", listen=[at], connect=[at])
    late.system.set_discovery(True)
    with pytest.raises(NoSuchService):
        late.find(where(name="clock", container=here.name), wait_s=1.5)


def test_a_camera_whose_container_dies_is_offered_elsewhere(
    start_container: StartContainer, only: Only, here: Container
) -> None:
    eyes, spare = start_container("eyes"), start_container("spare")
    eyes.register(Camera(), "rosie.eyes")
    stand_by(spare, Camera(), "rosie.eyes")
    wait_until(lambda: seers(here) == ["eyes"])
    rules = only("elsewhere")
    eyes.close()
    assert first(rules).ok
    wait_until(lambda: seers(here) == ["spare"])
    assert here.call(where(name="check_for"), "mug")


def test_a_degraded_camera_is_replaced_and_withdrawn(
    start_container: StartContainer, only: Only, here: Container
) -> None:
    eyes, spare, camera = start_container("eyes"), start_container("spare"), Camera()
    eyes.register(camera, "rosie.eyes")
    stand_by(spare, Camera(), "rosie.eyes")
    wait_until(lambda: seers(here) == ["eyes"])
    rules = only("degraded")
    eyes.set_health(camera, "degraded: fogged up")
    firing = first(rules)
    assert (firing.service, firing.ok) == ("rosie.eyes.check_for", True)
    wait_until(lambda: seers(here) == ["spare"])
    assert [info.provider for info in eyes.system.withdrawn()] == ["Camera-1"]


def test_a_lamp_that_is_missing_is_made(
    start_container: StartContainer, only: Only, here: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    lamps = start_container("lamps", instantiable=("lamp:Lamp",))
    wait_until(lambda: here.services(where(name="instantiate", container="lamps")))
    firing = first(only("porch", CARE))
    assert (firing.ok, [did.service for did in firing.steps]) == (True, ["trade.instantiate"])
    wait_until(lambda: here.services(where(name="shine")))
    [shine] = here.services(where(name="shine"))
    assert (shine.container, shine.groups) == (lamps.name, ("home.porch",))
    shine(0.5)


@pytest.fixture
def mind(start_container: StartContainer, here: Container, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Planner:
    """The planner of container "mind"; two workers may make another one, and the second worker is less busy."""
    text = f"from {__name__} import Planner as Ours\nclass Planner(Ours): ...\n"
    (tmp_path / "mind.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(Planner, "made", [])
    planner = Planner()
    for name in BUSY:
        start_container(name, instantiable=["mind:Planner"])
        here.find(where(name="instantiate", container=name), wait_s=30)
    start_container("mind").register(planner, "mind.planner")
    here.find("mind.planner.busy", wait_s=30)
    return planner


BUSY = {"worker-1": 0.7, "worker-2": 0.2}


def planning(looking: Container) -> list[str]:
    return sorted(handle.container for handle in looking.services("mind.planner.plan"))


def test_two_planners_share_the_jobs_once_the_first_has_too_much_to_do(
    mind: Planner, only: Only, here: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as reports:
        reports.setattr(picking, "busyness", lambda load, under_way: (BUSY[load.container], 0.0))
        rules = only("balance", every_s="0.02")
        wait_until(lambda: any(info.fired for info in here.notifications()))
        assert rules.rule_firings() == []
        assert planning(here) == ["mind"]
        mind.load = 0.9
        firing = first(rules)
        assert firing.ok
        assert [(did.service, did.container) for did in firing.steps] == [("trade.instantiate", "worker-2")]
    wait_until(lambda: planning(here) == ["mind", "worker-2"])
    goals = [f"job {number}" for number in range(40)]
    with ThreadPoolExecutor(8, "client") as clients:
        made = list(clients.map(lambda goal: here.call("mind.planner.plan", goal, pick="least_busy"), goals))
    assert made == goals
    first_one, second = Planner.made
    assert sorted(first_one.plans + second.plans) == sorted(goals)
    assert 10 <= len(first_one.plans) <= 30


def test_the_second_planner_ends_once_the_first_has_little_to_do(mind: Planner, only: Only, here: Container) -> None:
    [busy, *_] = here.call(where(name="instantiate", container="worker-2"), "mind:Planner", [], ["mind.planner"])
    wait_until(lambda: planning(here) == ["mind", "worker-2"])
    mind.load = 0.45
    rules = only("ease")
    wait_until(lambda: any(info.fired > 1 for info in here.notifications()))
    assert rules.rule_firings() == []
    assert planning(here) == ["mind", "worker-2"]
    mind.load = 0.2
    firing = first(rules)
    assert firing.ok
    assert [(did.service, did.container) for did in firing.steps] == [("trade.terminate", "worker-2")]
    wait_until(lambda: planning(here) == ["mind"])
    with pytest.raises(ServiceGone):
        busy.with_(deadline_s=5)()


def test_all_of_them_together_do_not_run_in_circles_when_a_camera_is_replaced(
    start_container: StartContainer, here: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rules_module, "LOOK_S", 0.02)
    eyes, spare, camera = start_container("eyes"), start_container("spare"), Camera()
    eyes.register(camera, "rosie.eyes")
    stand_by(spare, Camera(), "rosie.eyes")
    wait_until(lambda: seers(here) == ["eyes"])
    with Rules(here, SHIPPED) as rules:
        eyes.set_health(camera, "degraded: fogged up")
        wait_until(lambda: seers(here) == ["spare"])
        wait_until(rules.rule_firings)
        assert [(firing.rule, firing.ok) for firing in rules.rule_firings()] == [("degraded", True)]
        assert {info.state for info in rules.rules()} == {"standing"}


def test_an_unhealthy_planner_continues_elsewhere_with_its_state(
    start_container: StartContainer, only: Only, here: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy = {"worker-1": 70.0, "worker-2": 20.0}
    monkeypatch.setattr(_departing, "busyness", lambda load: (busy[load.container], 0.0))
    mind, planner = start_container("mind"), Planner()
    for name in busy:
        start_container(name, instantiable=[f"{__name__}:Planner"])
    planner.load = 0.75
    mind.register(planner, "mind.planner")
    for name in (*busy, "mind"):
        here.find(where(name="migrate", container=name), wait_s=30)
    here.find(where(name="plan"), wait_s=30)
    rules = only("relocate")
    mind.set_health(planner, "degraded: the host is too hot")
    firing = first(rules)
    assert firing.ok
    assert [did.service for did in firing.steps] == ["trade.migrate"]
    wait_until(lambda: [one.container for one in here.services(where(name="plan"))] == ["worker-2"])
    assert here.call(where(name="busy")) == 0.75


def test_a_dry_run_of_relocating_says_whom_it_would_ask_and_moves_nothing(
    start_container: StartContainer, here: Container
) -> None:
    mind, planner = start_container("mind"), Planner()
    mind.register(planner, "mind.planner")
    mind.set_health(planner, "degraded: the host is too hot")
    wait_until(lambda: here.services(where(name="plan", healthy=False)))
    here.find(where(name="migrate", container="mind"), wait_s=30)
    [rehearsal] = rehearse(here, {"relocate": read_rules(SHIPPED)["relocate"]})
    [step] = rehearsal.steps
    assert (step.service, step.container, step.result) == ("trade.migrate", "mind", "would be called")
    assert here.find(where(name="plan")).container == "mind"
