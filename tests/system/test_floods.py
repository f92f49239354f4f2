"""Where certificates identify clients, none takes another one's turn."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from trade import Container, Settings, service, where
from trade._threads import channel_workers
from trade.errors import Busy
from trade.transport.endpoints import free_endpoint

POLICY = policy_text(
    "robot=driver planner=operator mallory=operator", driver="register=lab", operator="read=* call=lab"
)


class Room:
    def __init__(self) -> None:
        self.open = threading.Event()
        self.inside = threading.Semaphore(0)

    @service(effect="read")
    def enter(self) -> None:
        self.inside.release()
        self.open.wait(60)

    @service(effect="read")
    def knock(self) -> str:
        return "who knocks?"


class Lab:
    """Containers by identity, each with a certificate and the policy; the robot is dialled by the others."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.papers = Papers(folder / "pki")
        self.policy = folder / "policy.toml"
        self.policy.write_text(POLICY)
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self._stack = stack
        self.robot = self.join("robot", listen=[self.endpoint])

    def join(self, identity: str, **how: Any) -> Container:
        how = how or {"connect": [self.endpoint]}
        settings = Settings.read(
            container=f"of-{identity}", tls=self.papers.of(identity), policy=self.policy, environment={}, **how
        )
        return self._stack.enter_context(Container(settings))


@pytest.fixture
def lab(tmp_path: Path, system: str) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(tmp_path, stack)


def test_a_client_that_uses_all_its_threads_does_not_affect_others(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel_workers, "MOST_THREADS", 2)
    room = Room()
    lab.robot.register(room, "lab")
    mallory, planner = lab.join("mallory"), lab.join("planner")
    enter = mallory.find(where(name="enter", group="lab"), wait_s=20)
    knock = planner.find(where(name="knock", group="lab"), wait_s=20)

    def entered() -> bool:
        """Another call of the same client may take the second thread for a moment."""
        enter.start()
        return room.inside.acquire(timeout=1)

    wait_until(entered, "a call is inside")
    runs = [enter.start() for _ in range(20)]
    assert any(isinstance(run.exception(20), Busy) for run in runs)
    assert knock() == "who knocks?"
    room.open.set()


def test_a_container_with_another_policy_is_heard(lab: Lab) -> None:
    lab.robot.register(Room(), "lab")
    lab.policy.write_text(POLICY + 'guest = ["operator"]\n')
    guest = lab.join("guest")
    assert guest.services(where(group="lab")) == []  # the robot's rules are those it began with
    lab.robot.load_policy(lab.policy)
    assert "guest" in lab.robot._parts.dispatcher.callers
