"""The hub of a host: containers that start after it have one link, to it, and work together as before."""

import os
import resource
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.unit.trade.conftest import StartProgram
from trade import Container, Resource, Settings, permit, service, where
from trade.errors import CannotConnect, ConfigurationError, LockedByOther, NoSuchService
from trade.hub_file import HubFile
from trade.transport.precedence import NICE
from trade.transport.zenoh import ZenohTransport
from trade.transport.zenoh_links import Links

StartContainer = Callable[..., Container]

POLICY = policy_text(
    "planner=operator mallory=operator arm=driver",
    head='gateways = ["door"]\n',
    operator="call=robot read=robot",
    driver="register=robot",
)


class Joint:
    """Something that is locked, moved, stopped and streamed."""

    def __init__(self) -> None:
        self.resource = Resource("joint")
        self.resources = [self.resource]
        self.moves: list[int] = []
        self.stops = 0

    @service
    def move(self, number: int) -> int:
        with permit(self.resources) as permitted:
            permitted.gate()
            self.moves.append(number)
        return number

    @service
    def go_on(self) -> None:
        """Comes back at once and moves until it is stopped."""
        with permit(self.resources) as permitted:
            permitted.gate()
            self.resource.moving = True

    @service(effect="read")
    def position(self) -> int:
        return len(self.moves)

    @service(effect="stop")
    def stop(self) -> None:
        self.stops += 1
        self.resource.moving = False


@pytest.fixture
def hub(start_container: StartContainer) -> Container:
    return start_container("hub", hub="serve")


@pytest.fixture
def joint() -> Joint:
    return Joint()


def links(container: Container) -> Links:
    assert isinstance(container._parts.transport, ZenohTransport)
    return container._parts.transport.links


def find(container: Container, name: str, group: str = "robot") -> Any:
    return container.find(where(name=name, group=group, local=False), wait_s=30).with_(deadline_s=30)


def test_attached_containers_have_one_link_and_work_together_with_linked_ones(
    hub: Container, start_container: StartContainer
) -> None:
    attached = [start_container(name) for name in ("a", "b", "c")]
    linked = [start_container(name, hub="off") for name in ("p", "q")]
    everyone = [hub, *attached, *linked]
    for container in everyone:
        container.register(Joint(), f"of.{container.name}")
    for container in everyone:
        for other in everyone:
            if other is not container:
                assert find(container, "move", f"of.{other.name}")(7) == 7
    assert [links(container).count() for container in attached] == [1, 1, 1]
    assert [container._parts.transport.relayed for container in everyone] == [False, *[True] * 3, False, False]
    assert [links(container).count() for container in linked] == [2, 2]
    assert links(hub).count() == len(attached) + len(linked)


@pytest.mark.parametrize(("path", "passes"), [("1", False), ("0", True)])
def test_calls_between_attached_containers_do_not_pass_through_the_hub(
    hub: Container,
    start_container: StartContainer,
    joint: Joint,
    monkeypatch: pytest.MonkeyPatch,
    path: str,
    passes: bool,
) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", path)
    session: Any = links(hub)._session
    tapped = session.declare_subscriber("call/**", zenoh.handlers.FifoChannel(1000))
    callee, caller = start_container("callee"), start_container("caller")
    callee.register(joint, "robot")
    move = find(caller, "move")
    with caller.lock(where(group="robot")):
        for number in range(10):
            move(number)
    assert joint.moves == list(range(10))
    if passes:
        tapped.recv()  # which waits: the hub may pass a call on before its own tap has it
    assert tapped.try_recv() is None or passes
    tapped.undeclare()


def test_a_container_that_attaches_knows_all_others_before_it_hears_of_their_signs_of_life(
    hub: Container, start_container: StartContainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"c{number}" for number in range(8)]
    for name in names:
        start_container(name).register(Joint(), f"of.{name}")
    presences, begun = ZenohTransport.presences, threading.Event()

    def heard_later(transport: ZenohTransport, pattern: str) -> Any:
        channel: Any = presences(transport, pattern)
        receive = channel.receive
        channel.receive = lambda: begun.wait(20) and receive()
        return channel

    monkeypatch.setattr(ZenohTransport, "presences", heard_later)
    late = start_container("late")
    known, services = {info.name for info in late.containers()}, late.services(where(name="move", kind="Joint"))
    begun.set()
    assert known == {"hub", "late", *names}
    assert len(services) == len(names)


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="threads have a nice value of their own on Linux only")
def test_the_threads_of_a_hub_precede_those_of_its_containers(start_program: StartProgram) -> None:
    def begun(program: str) -> Path:
        started = start_program(program)
        assert started.heard() == "up"
        return Path(f"/proc/{started.process.pid}/task")

    def nice(tasks: Path) -> dict[str, int]:
        return {
            (task / "comm").read_text().strip(): os.getpriority(os.PRIO_PROCESS, int(task.name))
            for task in tasks.iterdir()
        }

    hub, attached = map(nice, [begun(HUB), begun(ATTACHED)])
    sending = next(name for name in hub if name.startswith("tx"))
    allowed = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_NICE)[0] >= 20 - NICE
    assert (hub[sending], hub["python"]) == (NICE if allowed else 0, 0)
    assert set(attached.values()) == {0}


def test_samples_and_signs_of_life_pass_through_the_hub(
    hub: Container, start_container: StartContainer, joint: Joint
) -> None:
    source, listener = start_container("source"), start_container("listener")
    source.register(joint, "robot")
    find(listener, "position")
    with listener.stream(where(name="position", group="robot"), hz=100) as samples:
        assert [samples.next(30).value for _ in range(5)] == [0] * 5
    source.close()
    wait_until(lambda: len(listener.containers()) == 2)
    with pytest.raises(NoSuchService):
        listener.find(where(name="position", group="robot"), wait_s=0)


def test_an_attached_container_links_to_no_other_and_says_what_to_do(
    hub: Container, start_container: StartContainer
) -> None:
    attached = start_container("attached")
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        stranger.settimeout(0.2)
        endpoint = f"tcp/127.0.0.1:{stranger.getsockname()[1]}"
        with pytest.raises(CannotConnect, match=r"attached to the hub .* set TRADE_HUB=off"):
            attached.system.connect(endpoint)
        for switch in (attached.system.set_discovery, attached.system.set_broadcast):
            with pytest.raises(ConfigurationError, match="attached to the hub"):
                switch(True)
            switch(False)
        with pytest.raises(TimeoutError):  # nothing was dialled
            stranger.accept()
    assert links(attached).count() == 1


@pytest.mark.parametrize(
    "settings",
    [{"hub": "off"}, {"listen": ["tcp/127.0.0.1:0"]}, {"connect": ["the hub"]}],
    ids=lambda it: next(iter(it)),
)
def test_a_container_with_links_of_its_own_does_not_attach(
    hub: Container, start_container: StartContainer, settings: dict[str, Any]
) -> None:
    if "connect" in settings:
        settings = {"connect": [links(hub)._main_endpoint()]}
    linked = start_container("linked", **settings)
    assert links(linked).hub == ""
    assert len(links(linked).listen) == 1
    wait_until(lambda: len(linked.addresses()) == 2)


def test_a_setting_that_is_none_is_refused(system: str) -> None:
    with pytest.raises(ConfigurationError, match=r"TRADE_HUB: 'on' is none of auto, off, serve"):
        Settings.read(environment={"TRADE_HUB": "on", **os.environ})


def test_a_host_has_one_hub_and_the_next_one_listens_where_it_did(
    hub: Container, start_container: StartContainer
) -> None:
    with pytest.raises(ConfigurationError, match=rf"has a hub on this host already \(process {os.getpid()}\)"):
        start_container("second", hub="serve")
    port = links(hub).listen[0].port
    hub.close()
    assert links(start_container("second", hub="serve")).listen[0].port == port


def test_a_hub_whose_port_is_taken_says_who_has_to_restart(
    hub: Container, start_container: StartContainer, caplog: pytest.LogCaptureFixture
) -> None:
    port = links(hub).listen[0].port
    hub.close()
    with socket.create_server(("127.0.0.1", port)):
        second = start_container("second", hub="serve")
    assert links(second).listen[0].port != port
    assert f"port {port} of the last hub is taken: containers that were attached have to restart" in caplog.text
    assert links(start_container("attached")).hub == links(second)._main_endpoint()


def test_who_listens_at_the_port_of_an_ended_hub_is_not_taken_for_it(
    hub: Container, start_container: StartContainer, system: str
) -> None:
    port = links(hub).listen[0].port
    hub.close()
    assert HubFile(system).last() is not None
    with socket.create_server(("127.0.0.1", port)) as stranger:
        stranger.settimeout(0.2)
        assert links(start_container("alone")).hub == ""
        with pytest.raises(TimeoutError):
            stranger.accept()


@pytest.mark.realtime
def test_a_container_with_other_credentials_is_refused_by_the_hub(
    hub: Container, start_container: StartContainer, joint: Joint, caplog: pytest.LogCaptureFixture
) -> None:
    start_container("arm").register(joint, "robot")
    stranger = start_container("stranger", credentials=("host", "guessed"))
    assert "does not use the hub" in caplog.text
    with pytest.raises(NoSuchService):
        stranger.find(where(name="move", group="robot"), wait_s=0.5)
    assert (len(stranger.addresses()), links(stranger).count(), links(hub).count()) == (1, 0, 1)


@pytest.fixture
def certified(
    start_container: StartContainer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Container]:
    """Starts containers with certificates and the policy; their calls pass through the hub."""
    monkeypatch.setenv("TRADE_LOCAL_PATH", "0")
    papers, policy = Papers(tmp_path / "pki"), tmp_path / "policy.toml"
    policy.write_text(POLICY)

    def start(name: str, **settings: Any) -> Container:
        kind: dict[str, Any] = {"purpose": "gateway"} if name == "door" else {}
        return start_container(f"c-{name}", tls=papers.of(name, **kind), policy=policy, **settings)

    return start


def test_no_attached_container_speaks_as_another_identity(certified: Callable[..., Container], joint: Joint) -> None:
    door = certified("door", hub="serve")
    arm, planner, mallory = certified("arm"), certified("planner"), certified("mallory")
    arm.register(joint, "robot")
    heard_session: Any = links(arm)._session
    assert [links(one).hub for one in (arm, planner, mallory)] == [links(door)._main_endpoint()] * 3
    tapped = heard_session.declare_subscriber("call/**", zenoh.handlers.FifoChannel(1000))
    assert find(planner, "move")(1) == 1
    heard = (str(sample.key_expr) for sample in tapped)  # which waits: the answer may be here first
    key = next(key for key in heard if key.startswith("call/planner/") and "/robot" in key)
    sends = mallory._parts.transport
    sends.announce(key, b"forged")
    sends.announce(key.replace("call/planner/", "call/mallory/"), b"own")
    while (payload := tapped.recv().payload.to_bytes()) != b"own":
        assert payload != b"forged"  # which was sent first, on the same link
    assert joint.moves == [1]
    tapped.undeclare()


def test_a_hub_that_the_policy_does_not_trust_is_not_used(
    certified: Callable[..., Container], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    door = certified("door", hub="serve")
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY.replace('"door"', '"gate"'))
    planner = certified("planner")
    assert links(planner).hub == ""
    assert "the policy does not list its identity, door, in gateways" in caplog.text
    door.close()
    with pytest.raises(ConfigurationError, match="does not list its identity, door, in gateways"):
        certified("door", hub="serve")


HUB = """
with Container(Settings.read(container="hub", hub="serve")):
    say("up")
    hear()
"""
ATTACHED = """
trade.container()
say("up")
hear()
"""
OWNER = """
import threading
lost = threading.Event()
lock = trade.lock(where(group="robot"), on_lost=lambda why: lost.set()).acquire()
with lock.use():
    trade.find(where(name="go_on", group="robot"), wait_s=30)()
say("moving", trade.container()._parts.transport.links.hub)
lost.wait(60)
say("lost", lock.held)
hear()
"""


@pytest.mark.realtime
def test_S12_if_the_hub_is_killed_motion_ends_and_a_lock_has_never_two_owners(
    start_program: StartProgram, start_container: StartContainer, joint: Joint, caplog: pytest.LogCaptureFixture
) -> None:
    hub = start_program(HUB)
    assert hub.heard() == "up"
    arm, other = start_container("arm"), start_container("other")
    arm.register(joint, "robot")
    owner = start_program(OWNER)
    said, endpoint = owner.heard().split()
    assert (said, endpoint) == ("moving", links(arm).hub)
    with pytest.raises(LockedByOther):
        other.lock(where(group="robot"), wait_s=0).acquire()
    assert joint.resource.moving
    hub.kill()
    wait_until(lambda: not joint.resource.moving, "the motion of a session out of sight ends")
    assert joint.stops
    assert arm._parts.locks.infos() == []
    assert owner.heard() == "lost False"
    assert "lost the hub of this host" in caplog.text
    assert other.reachability(limit_s=0).unreached.keys() == {endpoint}

    again = start_program(HUB)
    assert again.heard() == "up"
    wait_until(lambda: len(other.addresses()) == 4, "all see each other again")
    other.resume(where(group="robot"))
    with other.lock(where(group="robot")):
        assert find(other, "move")(1) == 1
    assert joint.moves == [1]
