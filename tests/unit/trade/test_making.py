"""Objects made on request, of classes that a container allows; their end, and that of a container."""

from pathlib import Path
from typing import Any

import pytest

import trade
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from trade import Container, Handle, Settings, errors, where
from trade.testing import MemorySystem

pytestmark = pytest.mark.virtual_time

MODULE = """
import subprocess
from subprocess import Popen
import trade
from trade import Resource, permit, service, where

events = []

class Lamp:
    def __init__(self, watts: int = 40, *, colour: str = "white") -> None:
        if watts < 0:
            raise ValueError("a lamp gives light")
        self.watts, self.colour = watts, colour

    @service(effect="read")
    def kind(self) -> tuple[int, str]:
        return self.watts, self.colour

    def close(self) -> None:
        events.append("closed")

class Wheel:
    def __init__(self) -> None:
        self.resources = (Resource("wheel"),)

    @service
    def turn(self) -> None:
        self.resources[0].moving = True
        events.append("turns")

    @service(effect="stop")
    def stop(self) -> None:
        self.resources[0].moving = False
        events.append("stopped")

    def close(self) -> None:
        events.append("closed")
        raise OSError("the bus is gone")

class Clock:
    def __init__(self) -> None:
        self.hour, self.resources = 0, (Resource("hand"),)

    @service(effect="read")
    def time(self) -> int:
        return self.hour

    @service
    def strike(self) -> None:
        with permit(self.resources) as allowed:
            allowed.gate()

    @service(effect="stop")
    def stop(self) -> None: ...

    def save_state(self):
        return {"hour": self.hour}

    def restore_state(self, state) -> None:
        if state["hour"] > 24:
            raise ValueError("no such hour")
        if state["hour"] > 12:
            self.strike()
        self.hour = state["hour"]
        events.append(f"restored {self.hour}")

    def close(self) -> None:
        events.append("clock closed")

class Watcher:
    def __init__(self) -> None:
        self.at_the_start = trade.container().name

    @service(effect="read")
    def home(self) -> tuple[str, str, str]:
        return self.at_the_start, trade.container().name, trade.find(where(name="kind")).container

    @service
    def turned(self) -> str:
        with trade.lock(where(name="turn")):
            trade.find(where(name="turn"))()
        return trade.container().settings.system

class Tidy(Watcher):
    def close(self) -> None:
        trade.close()

class Mute:
    def close(self) -> None:
        events.append("closed")

number = 3
"""

POLICY = policy_text(
    "chief=chief,viewer maker=driver dash=viewer", chief="administer=*", driver="register=*", viewer="read=*"
)


@pytest.fixture
def events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What objects of module ``workshop`` did."""
    (tmp_path / "workshop.py").write_text(MODULE)
    (tmp_path / "broken.py").write_text("raise RuntimeError('not today')\n")
    (tmp_path / "needy.py").write_text("import no_such_package_anywhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("workshop", "broken", "needy"):
        monkeypatch.delitem(__import__("sys").modules, name, raising=False)
    import importlib

    return importlib.import_module("workshop").events


@pytest.fixture
def maker(memory: MemorySystem, events: list[str]) -> Container:
    container = memory.container(
        "maker", identity="maker", instantiable=["workshop:*", "broken:It", "needy:It", "gone.*"]
    )
    memory.settle()
    return container


@pytest.fixture
def asker(memory: MemorySystem, maker: Container) -> Container:
    container = memory.container("asker", identity="chief")
    memory.settle()
    return container


def ask(asker: Container, name: str, *args: Any) -> Any:
    return asker.find(where(name=name, container="maker"))(*args)


@pytest.mark.parametrize(
    ("args", "lamp"),
    [((), (40, "white")), ((60,), (60, "white")), ({"watts": 5, "colour": "red"}, (5, "red"))],
)
def test_an_object_is_made_elsewhere_and_its_services_are_called(
    asker: Container, memory: MemorySystem, args: Any, lamp: tuple[int, str]
) -> None:
    [kind] = ask(asker, "instantiate", "workshop:Lamp", args, ["hall"])
    memory.settle()
    assert (kind.container, kind.groups, kind()) == ("maker", ("hall",), lamp)


def test_what_was_made_finds_and_locks_in_the_system_of_its_container(
    asker: Container, maker: Container, memory: MemorySystem
) -> None:
    ask(asker, "instantiate", "workshop:Lamp", (), ["hall"])
    ask(asker, "instantiate", "workshop:Wheel", (), ["cart"])
    ask(asker, "instantiate", "workshop:Watcher", (), ["rosie.watch"])
    memory.settle()
    assert asker.find(where(name="home"))() == ("maker", "maker", "maker")
    assert asker.find(where(name="turned"))() == maker.settings.system
    assert {info.name for info in asker.containers()} == {"maker", "asker"}


def test_an_object_that_closes_the_default_container_ends_nothing_of_its_host(
    asker: Container, maker: Container, memory: MemorySystem
) -> None:
    ask(asker, "instantiate", "workshop:Lamp", (), ["hall"])
    [home, _] = ask(asker, "instantiate", "workshop:Tidy", (), ["rosie.watch"])
    memory.settle()
    assert home()[0] == "maker"
    ask(asker, "terminate", home)
    assert not maker.closed
    assert asker.find(where(name="kind"))() == (40, "white")
    assert trade.container() is maker


def test_a_program_that_has_a_default_container_keeps_it(
    asker: Container, memory: MemorySystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade._container.default._default", asker)
    ask(asker, "instantiate", "workshop:Lamp", (), ["hall"])
    ask(asker, "instantiate", "workshop:Watcher", (), ["rosie.watch"])
    memory.settle()
    assert asker.find(where(name="home"))() == ("asker", "asker", "maker")


def test_a_container_that_was_closed_remains_the_default_one_until_another_one_hosts(
    memory: MemorySystem, events: list[str]
) -> None:
    for name in ("first", "second"):
        with memory.container(name, instantiable=["workshop:*"]) as maker:
            maker.system.instantiate("workshop:Lamp")
            [home, _] = maker.system.instantiate("workshop:Watcher")
            assert home()[0] == name
    with pytest.raises(errors.ConfigurationError, match="closed"):
        trade.services()  # not in another system, which a thread that still runs would start


def test_a_container_makes_only_what_its_settings_allow(memory: MemorySystem, events: list[str]) -> None:
    with pytest.raises(errors.NotInstantiable, match=r"It allows no class\. Start it with `trade container --allow"):
        memory.container("plain").system.instantiate("workshop:Lamp")


@pytest.mark.parametrize(
    ("path", "kind", "complaint"),
    [
        ("subprocess:Popen", errors.NotInstantiable, "may not create a subprocess:Popen. It allows only workshop:"),
        ("workshop:Lantern", errors.NoSuchClass, "workshop has no such class"),
        ("workshop:number", errors.NoSuchClass, "workshop has no such class"),
        ("workshop:Popen", errors.NoSuchClass, "it is defined as subprocess:Popen"),
        ("workshop:subprocess.Popen", errors.NoSuchClass, "it is defined as subprocess:Popen"),
        ("workshop:", errors.NoSuchClass, "a path looks like package.module:Class"),
        ("gone.away:It", errors.NoSuchClass, "No module named 'gone'"),
        ("broken:It", errors.CannotInstantiate, "RuntimeError: not today"),
        ("needy:It", errors.CannotInstantiate, "No module named 'no_such_package_anywhere'"),
    ],
)
def test_what_is_not_made_says_why(asker: Container, path: str, kind: type[Exception], complaint: str) -> None:
    with pytest.raises(kind, match=complaint):
        ask(asker, "instantiate", path)


def test_a_constructor_that_fails_leaves_nothing(asker: Container) -> None:
    with pytest.raises(
        errors.CannotInstantiate, match="workshop:Lamp could not be created in container maker: ValueError: a lamp"
    ):
        ask(asker, "instantiate", "workshop:Lamp", [-1])
    with pytest.raises(errors.CannotInstantiate, match="TypeError"):
        ask(asker, "instantiate", "workshop:Lamp", {"amperes": 1})
    with pytest.raises(errors.NoSuchService):
        asker.find(where(kind="Lamp"), wait_s=0)


@pytest.mark.parametrize(("path", "groups"), [("workshop:Mute", ()), ("workshop:Lamp", ("not a group",))])
def test_what_cannot_be_registered_is_closed_again(
    asker: Container, events: list[str], path: str, groups: tuple[str, ...]
) -> None:
    with pytest.raises(errors.ConfigurationError):
        ask(asker, "instantiate", path, (), groups)
    assert events == ["closed"]


def test_what_was_made_is_terminated_at_rest_and_closed(
    asker: Container, memory: MemorySystem, events: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    handles: dict[str, Handle] = {one.name: one for one in ask(asker, "instantiate", "workshop:Wheel", (), ["cart"])}
    memory.settle()
    handles["turn"]()
    ask(asker, "terminate", handles["stop"])
    assert events == ["turns", "stopped", "closed"]
    assert "Wheel could not be closed" in caplog.text
    memory.settle()
    with pytest.raises(errors.ServiceGone):
        handles["turn"]()
    with pytest.raises(errors.ConfigurationError, match="not made by instantiate"):
        ask(asker, "terminate", handles["turn"])


def test_what_was_made_and_is_withdrawn_is_terminated_too(
    asker: Container, maker: Container, memory: MemorySystem, events: list[str]
) -> None:
    [kind] = ask(asker, "instantiate", "workshop:Lamp")
    ask(asker, "deregister", kind)
    ask(asker, "terminate", kind)
    assert events == ["closed"]
    assert maker.system.withdrawn() == []


def test_only_what_was_made_there_is_terminated(asker: Container, maker: Container) -> None:
    clock = asker.find(where(name="clock", container="maker"))
    [kind] = ask(asker, "instantiate", "workshop:Lamp")
    for wrong in (clock, asker.find(where(name="clock", container="asker"))):
        with pytest.raises(errors.ConfigurationError, match="not made by instantiate"):
            ask(asker, "terminate", wrong)
    maker.system.terminate(kind)


def test_what_was_made_is_closed_with_its_container(maker: Container, events: list[str]) -> None:
    maker.system.instantiate("workshop:Lamp")
    maker.close()
    assert events == ["closed"]


def test_a_container_ends_at_rest_on_request_and_answers_the_requester(
    asker: Container, maker: Container, memory: MemorySystem, events: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    handles = {one.name: one for one in ask(asker, "instantiate", "workshop:Wheel", (), ["cart"])}
    memory.settle()
    handles["turn"]()
    assert list(ask(asker, "terminate_container", "the cart goes home")) == []
    assert events[:2] == ["turns", "stopped"]
    wait_until(lambda: events[2:] == ["closed"])
    wait_until(lambda: not maker.healthy())
    assert "container maker is terminated by chief: the cart goes home" in caplog.text


def test_what_is_to_end_only_at_rest_is_left_while_it_moves_or_is_locked(
    asker: Container, maker: Container, memory: MemorySystem, events: list[str]
) -> None:
    handles = {one.name: one for one in ask(asker, "instantiate", "workshop:Wheel", (), ["cart"])}
    memory.settle()
    handles["turn"]()
    with pytest.raises(errors.InUse, match="wheel moves"):
        ask(asker, "terminate_container", "", True)
    handles["stop"]()
    with (
        asker.lock(where(group="cart"), purpose="parade"),
        pytest.raises(errors.InUse, match=r"wheel is locked by .*asker for 'parade'"),
    ):
        ask(asker, "terminate_container", "", True)
    assert events == ["turns", "stopped"]
    assert maker.healthy()
    assert list(ask(asker, "terminate_container", "", True)) == []
    wait_until(lambda: not maker.healthy())


def test_terminating_twice_is_like_terminating_once(maker: Container) -> None:
    for _ in range(2):
        assert maker.system.terminate_container() == []
    wait_until(lambda: not maker.healthy())


@pytest.fixture
def governed(memory: MemorySystem, maker: Container, asker: Container, tmp_path: Path) -> Path:
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY)
    maker.load_policy(policy)
    asker.load_policy(policy)
    return policy


STATEFUL = "workshop:Clock"


def test_a_provider_made_with_a_state_has_it_before_any_client_can_call_it(
    asker: Container, memory: MemorySystem, events: list[str]
) -> None:
    seen: list[str] = []
    asker.joined(where(kind="Clock"), call=lambda handle: seen.append(" ".join(events)))
    made = {one.name: one for one in ask(asker, "instantiate", STATEFUL, (), ["hall"], {"hour": 7})}
    memory.settle()
    assert made["time"]() == 7
    made["strike"]()  # it is held still no longer
    wait_until(lambda: len(seen) == len(made))
    assert set(seen) == {"restored 7"}
    ask(asker, "terminate", made["time"])
    assert events == ["restored 7", "clock closed"]


@pytest.mark.parametrize("hour", [25, 13])
def test_S18_what_does_not_take_its_state_or_moves_by_it_is_not_offered_and_closed(
    asker: Container, memory: MemorySystem, events: list[str], hour: int
) -> None:
    said = {25: "ValueError: no such hour", 13: "LockedByOther"}[hour]
    with pytest.raises(errors.CannotInstantiate, match=said):
        ask(asker, "instantiate", STATEFUL, (), ["hall"], {"hour": hour})
    memory.settle()
    assert events == ["clock closed"]
    with pytest.raises(errors.NoSuchService):
        asker.find(where(kind="Clock"), wait_s=0)


def test_making_and_terminating_need_the_right_to_administer(governed: Path, asker: Container) -> None:
    [kind] = ask(asker, "instantiate", "workshop:Lamp", (), ["hall"])
    ask(asker, "terminate", kind)
    assert list(ask(asker, "terminate_container", "")) == []


@pytest.mark.parametrize(
    ("name", "args"),
    [
        ("instantiate", ("workshop:Lamp",)),
        ("terminate_container", ("because",)),
        ("start_container", ("robot", "eyes")),
    ],
)
def test_the_asked_container_refuses_a_client_that_may_not_administer(
    governed: Path, memory: MemorySystem, maker: Container, events: list[str], name: str, args: tuple[str, ...]
) -> None:
    dash = memory.container("careless", identity="dash")
    memory.settle()
    with pytest.raises(errors.AccessDenied, match=f"dash may not administer trade.{name}"):
        ask(dash, name, *args)
    assert maker.healthy()
    assert events == []


def test_a_client_that_has_lost_the_role_meanwhile_is_refused(
    governed: Path, maker: Container, memory: MemorySystem
) -> None:
    careless = memory.container("careless", identity="chief")
    memory.settle()
    [kind] = ask(careless, "instantiate", "workshop:Lamp", (), ["hall"])
    governed.write_text(POLICY.replace('chief = ["chief", "viewer"]', 'chief = ["viewer"]'))
    maker.load_policy(governed)
    with pytest.raises(errors.AccessDenied, match=r"chief may not administer trade.instantiate"):
        ask(careless, "instantiate", "workshop:Lamp", (), ["hall"])
    with pytest.raises(errors.AccessDenied, match=r"chief may not administer trade.terminate"):
        ask(careless, "terminate", kind)
    assert maker.find(where(name="kind")) == kind


def test_a_container_offers_what_it_makes_by_its_own_rights(
    governed: Path, asker: Container, maker: Container, events: list[str]
) -> None:
    governed.write_text(POLICY.replace('register = ["*"]', 'register = ["garage"]'))
    maker.load_policy(governed)
    with pytest.raises(errors.AccessDenied, match="maker may not register Lamp in hall"):
        ask(asker, "instantiate", "workshop:Lamp", (), ["hall"])
    assert events == ["closed"]


def test_the_environment_names_what_may_be_made() -> None:
    read = Settings.read(environment={"TRADE_INSTANTIABLE": "mypkg.vision:Camera, mypkg.arms.*", "TRADE_SYSTEM": "s"})
    assert read.instantiable == ("mypkg.vision:Camera", "mypkg.arms.*")
    assert Settings.read(environment={"TRADE_SYSTEM": "s"}).instantiable == ()
    assert Settings.read(instantiable=["a:B"], environment={"TRADE_INSTANTIABLE": "c:D"}).instantiable == ("a:B",)


def test_a_program_says_what_happens_when_a_client_ends_its_container() -> None:
    ended: list[str] = []
    with Container(Settings.read(container="cart"), on_terminate=lambda: ended.append("the program ends")) as cart:
        cart.system.terminate_container("the cart goes home")
        wait_until(lambda: ended, "the program hears of it")
        assert (ended, cart.closed) == (["the program ends"], False)
