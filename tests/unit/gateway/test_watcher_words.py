"""``trade notifications`` and ``trade hooks``: those of the whole system are listed and ended from the command line."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from trade import Container, HookEvent, service, where
from trade.errors import NoSuchHook, NoSuchNotification
from trade_gateway.cli import app

pytestmark = pytest.mark.virtual_time

StartContainer = Callable[..., Container]


def trade(*words: str) -> Any:
    return CliRunner().invoke(app, list(words))


class Battery:
    @service(effect="read")
    def is_low(self) -> bool:
        return False

    @service
    def dock(self, speed: float = 0.1) -> None: ...

    @service(effect="read")
    def saw(self, called: HookEvent) -> None: ...


@pytest.fixture
def base(start_container: StartContainer) -> Container:
    container = start_container("base")
    container.register(Battery(), "rosie.base")
    return container


def test_notifications_are_listed_and_cancelled(base: Container) -> None:
    dock, is_low = base.find(where(name="dock")), base.find(where(name="is_low"))
    noted = base.every(60, dock.bind(0.3), if_=is_low)
    [reported] = json.loads(trade("notifications", "--json").stdout)
    assert (reported["id"], reported["occasion"], reported["call"]) == (noted.id, "every 60 s", "rosie.base.dock(0.3)")
    assert (reported["condition"], reported["container"], reported["fired"]) == ("if rosie.base.is_low()", "base", 0)
    table = trade("notifications").stdout
    assert all(text in table for text in ("OCCASION", noted.id, "every 60 s", "rosie.base.dock(0.3)", base.session))
    assert f"cancelled: {noted.id}" in trade("notifications", "--cancel", noted.id).stdout
    assert not noted.active
    assert "there is no notification" in trade("notifications").stdout
    assert json.loads(trade("notifications", "--json").stdout) == []


def test_hooks_are_listed_and_detached(base: Container) -> None:
    dock = base.find(where(name="dock"))
    hook = base.after_service(dock, base.find(where(name="saw")))
    dock()
    [reported] = json.loads(trade("hooks", "--json").stdout)
    assert (reported["id"], reported["side"], reported["target"]) == (hook.id, "after", "rosie.base.dock")
    assert (reported["call"], reported["services"], reported["fired"]) == ("rosie.base.saw", ["rosie.base.dock"], 1)
    table = trade("hooks").stdout
    assert all(text in table for text in ("TARGET", hook.id, "attached", "rosie.base.saw", base.session))
    assert f"detached: {hook.id}" in trade("hooks", "--detach", hook.id).stdout
    assert hook.infos() == []
    assert "no hook is attached" in trade("hooks").stdout


@pytest.mark.parametrize(
    ("words", "error"),
    [(("notifications", "--cancel", "x.1"), NoSuchNotification), (("hooks", "--detach", "x.h1"), NoSuchHook)],
    ids=["notification", "hook"],
)
def test_an_unknown_id_is_reported(base: Container, words: tuple[str, ...], error: type[Exception]) -> None:
    said = trade(*words)
    assert isinstance(said.exception, error)
    assert f"`trade {words[0]}` lists them" in str(said.exception)
