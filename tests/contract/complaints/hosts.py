"""Two containers between which nothing goes to a group of hosts: only who is dialled is reached."""

import contextlib
import secrets
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.system.conftest import networks_of_ones_own
from tests.system.member import PROVIDERS
from tests.system.networks import Member, ip
from trade import Container, Settings, service, where
from trade.transport.endpoints import free_endpoint

__all__ = ["Loopback", "Wifi"]

_SYSTEM = "complaints"


class _Lamp:
    @service
    def shine(self, level: float) -> bool:
        return level > 0


class Loopback:
    """In this process, with no folder in common: nothing but the endpoint leads from one to the other."""

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        self._undo, self._patch = undo, undo.enter_context(pytest.MonkeyPatch.context())
        self._folder, endpoint = tmp_path, free_endpoint()
        self._robot = self._started("robot", listen=[endpoint])
        self._planner = self._started("planner", connect=[endpoint])

    def _started(self, name: str, **settings: Any) -> Container:
        self._patch.setenv("TRADE_RUNTIME_DIR", str(self._folder / name))
        made = Settings.read(system=_SYSTEM, container=name, credentials=("lab", "secret"), **settings)
        return self._undo.enter_context(Container(made))

    def reached(self) -> bool:
        """Whether the planner finds what the robot offers, and is answered."""
        if not self._robot.services(where(group="lamp")):
            self._robot.register(_Lamp(), "lamp")
        shine = self._planner.services(where(group="lamp"))
        return bool(shine) and shine[0](0.5)


class Wifi:
    """On hosts of their own, on a network that carries no multicast, as Wi-Fi and VPNs often do not."""

    _addresses = ("10.231.8.1", "10.231.8.2")

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        networks = undo.enter_context(networks_of_ones_own())
        patch = undo.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("TRADE_SYSTEM", f"{_SYSTEM}-{secrets.token_hex(3)}")
        networks.lay("wifi", robot=self._addresses[0], planner=self._addresses[1])
        members = []
        for name, address in zip(("robot", "planner"), self._addresses, strict=True):
            host = networks.host(name)
            ip("-n", host, "link", "set", "wifi", "multicast", "off")
            members.append(undo.enter_context(contextlib.closing(Member(host, name, f"{address}:0", tmp_path))))
        self._robot, self._planner = members
        endpoint = self._robot.ask("start")
        self.link(endpoint)
        for each in members:
            each.ask("register")

    def link(self, endpoint: str) -> None:
        """Have the planner started so that it finds the robot: it dials it."""
        self._planner.ask("start", endpoint)

    def link_by_multicast(self, endpoint: str) -> None:
        """The same, as most middleware does it: both send a broadcast to find others."""
        self._planner.ask("start")
        for each in (self._robot, self._planner):
            each.ask("find_each_other")

    def reached(self) -> bool:
        """Whether the planner is answered by all services of both."""
        return bool(self._planner.ask("call_all") == 2 * PROVIDERS)
