"""Notifications for others, under a policy: to ask takes one right, each firing the right to the call."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from trade import Container, NotificationInfo, service

pytestmark = pytest.mark.realtime

POLICY = policy_text(
    "keeper=keeper asker=driver watcher=watcher stranger=",
    keeper="register=rosie call=rosie administer=trade",
    watcher="instrument=trade",
    driver="includes=watcher call=rosie.base",
)

ASKER = """
from pathlib import Path
identity, policy, s = sys.argv[1:]
container = Container(Settings.read(container="asker", identity=identity, policy=Path(policy) if policy else None))
try:
    go = container.find(where(name="go", group="rosie.base"), wait_s=20)
    say(container.every(float(s), go, host="keeper").id)
except trade.errors.AccessDenied as denied:
    say(denied.who, denied.verb, denied.what)
hear()
"""


class Base:
    def __init__(self) -> None:
        self.went = 0

    @service
    def go(self) -> None:
        self.went += 1


@pytest.fixture
def base() -> Base:
    return Base()


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    return path


@pytest.fixture
def keeper(start_container: Callable[..., Container], policy: Path, base: Base) -> Container:
    """Keeps notifications for others, and offers what they call."""
    container = start_container("keeper", identity="keeper", policy=policy)
    container.register(base, "rosie.base")
    return container


def only(keeper: Container) -> NotificationInfo:
    [info] = keeper.notifications()
    return info


@pytest.mark.parametrize("careless", [False, True], ids=["asks its policy", "asks no policy"])
def test_a_client_without_the_right_to_instrument_gets_no_notification_elsewhere(
    keeper: Container, policy: Path, base: Base, start_program: Any, careless: bool
) -> None:
    asker = start_program(ASKER, "stranger", "" if careless else str(policy), "0.02")
    assert asker.heard() == "stranger instrument trade.notify"
    assert keeper.notifications() == []


def test_a_notification_without_the_right_to_its_call_is_refused_at_every_firing(
    keeper: Container, policy: Path, base: Base, start_program: Any
) -> None:
    asker = start_program(ASKER, "watcher", str(policy), "0.02")
    noted = asker.heard()
    wait_until(lambda: only(keeper).failures >= 3)
    assert only(keeper).id == noted
    assert only(keeper).owner.startswith("watcher/asker/")
    assert only(keeper).last_error.startswith("AccessDenied: watcher may not call rosie.base.go")
    assert (only(keeper).fired, base.went) == (0, 0)


def test_a_notification_is_refused_while_its_owner_lacks_the_role(
    keeper: Container, policy: Path, base: Base, start_program: Any
) -> None:
    asker = start_program(ASKER, "asker", str(policy), "0.02")
    asker.heard()
    wait_until(lambda: base.went >= 2)
    policy.write_text(POLICY.replace('asker = ["driver"]', 'asker = ["watcher"]'))
    keeper.load_policy(policy)
    refused = only(keeper).failures
    wait_until(lambda: only(keeper).failures >= refused + 3)
    went = base.went
    refused = only(keeper).failures
    wait_until(lambda: only(keeper).failures >= refused + 3)
    assert base.went == went
    policy.write_text(POLICY)
    keeper.load_policy(policy)
    wait_until(lambda: base.went >= went + 2)


def test_cancelling_a_foreign_notification_needs_the_right_to_administer(
    keeper: Container, policy: Path, start_program: Any
) -> None:
    noted = start_program(ASKER, "asker", str(policy), "60").heard()
    thief = start_program(
        """
        from pathlib import Path
        container = Container(Settings.read(container="thief", identity="stranger", policy=Path(sys.argv[2])))
        container.find(where(name="notify", container="keeper"), wait_s=20)
        try:
            container.cancel_notification(sys.argv[1])
        except trade.errors.AccessDenied as denied:
            say(denied.who, denied.verb, denied.what)
        hear()
        """,
        noted,
        str(policy),
    )
    assert thief.heard() == f"stranger administer notification {noted}"
    assert only(keeper).id == noted
    keeper.cancel_notification(noted)
    assert keeper.notifications() == []
