"""A simulated twin of the robot for dry runs of calls."""

import os
import secrets
import shutil
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

import msgspec
from msgspec import Struct

from trade import Container, Handle, Settings
from trade.errors import NoSuchService, TradeError
from trade_gateway._usage import find
from trade_gateway.clients._errors import NoTwin
from trade_gateway.process._json_child import ChildFailed, JsonChild, bare_environment

_UP_S: Final = 60.0
_SEEN_S: Final = 10.0
_PLACED_WITHIN_S: Final = 60.0
_PLACES: Final = "TRADE_RUNTIME_DIR"
_NEAR_RAD: Final = 0.005
"""A joint this near is not moved again."""


class TwinResult(Struct, frozen=True):
    """The result of a call on the twin."""

    ok: bool
    error: str
    """The error; empty on success."""
    result: Any
    took_s: float
    """Duration in simulation, in seconds."""
    began_where_the_robot_is: bool
    """Whether the whole twin was first brought to the robot's position."""
    elsewhere: tuple[str, ...]
    """The groups that are not where the robot is, or of which the robot's position is unknown."""
    before: Any
    """Its ``state`` before the call, and"""
    after: Any
    """after it."""


class Twin:
    """``trade up ROBOT.toml --sim`` in a separate system, started at its first use.

    Args:
        robot: the robot file.
    """

    def __init__(self, robot: Path) -> None:
        self._robot = robot
        self._lock = threading.Lock()
        self._folder = Path(tempfile.mkdtemp(prefix="trade-twin-"))
        self._system = f"twin-{secrets.token_hex(4)}"
        self._process: JsonChild | None = None
        self._container: Container | None = None

    def call(self, handle: Handle, args: Any, deadline_s: float, states: Mapping[str, Any]) -> TwinResult:
        """Brings the whole twin to the robot's position and makes the call there; one at a time.

        Args:
            handle: the service of the real robot.
            args: positional or named.
            deadline_s: the call's deadline in seconds.
            states: the ``state`` of each group of the real robot; None if it could not be read.

        Raises:
            NoTwin: the twin does not start, or has no such service.
        """
        with self._lock:
            here = self._up()
            group, name = handle.key.domain, handle.name
            tried = self._find(here, group, name, _SEEN_S)
            if tried is None:
                raise NoTwin(reason=f"the twin of {self._robot.name} has no {handle.label}")
            ordered = sorted(states.items(), key=lambda one: not isinstance(one[1], list))  # groups before their joints
            elsewhere = tuple(one for one, state in ordered if not self._place(here, one, state))
            before, began = self._state(here, group), time.monotonic()
            result, error = None, ""
            try:
                result = _called(tried, args, deadline_s)
            except Exception as failed:  # noqa: BLE001 - any exception of a provider is the result of the dry run
                error = f"{type(failed).__name__}: {failed}"
            took_s = time.monotonic() - began
            placed, after = bool(states) and not elsewhere, self._state(here, group)
            return TwinResult(not error, error, result, round(took_s, 3), placed, elsewhere, before, after)

    def _up(self) -> Container:
        if self._container is not None and self._process is not None and self._process.running:
            return self._container
        self._end()
        environment = {**bare_environment(), "TRADE_SYSTEM": self._system, "TRADE_STATE_DIR": str(self._folder)}
        environment |= {name: value for name, value in os.environ.items() if name == _PLACES}
        words = ["trade_gateway", "--with-stdin", "up", str(self._robot), "--sim", "--name", "twin", "--json"]
        self._process = JsonChild("twin", words, environment, self._folder / "complaints")
        try:
            self._process.read_message(_UP_S)
        except ChildFailed as failed:
            raise NoTwin(reason=failed.problem) from None
        own = Settings.read(system=self._system, container="tries", connect=[])
        self._container = Container(
            replace(own, tls=None, policy=None, listen=(), lock="", audit=None, metrics="", instantiable=())
        )
        return self._container

    def _place(self, here: Container, group: str, state: Any) -> bool:
        """Brings a group to the real one's position; returns whether it arrived. A sensor has no position."""
        plain, there = msgspec.to_builtins(state), self._state(here, group)
        try:
            match plain:
                case None:
                    return False
                case [{"position_rad": _}, *_]:
                    if not _is_at(plain, there):
                        self._do(here, group, "move_to", [one["position_rad"] for one in plain])
                case {"positions_rad": list()}:
                    self._do(here, group, "power_on")
                    self._do(here, group, "release_brakes")
                    self._do(here, group, "move_joints", plain["positions_rad"])
                case {"position_rad": float() | int() as angle}:
                    if not _is_at([plain], [there]):
                        self._do(here, group, "move_to", angle)
                case {"width_m": float() | int() as width}:
                    self._do(here, group, "activate")
                    self._do(here, group, "move_to", width)
                case _:
                    return True
        except (TradeError, KeyError):
            return False
        return True

    def _do(self, here: Container, group: str, name: str, *args: Any) -> None:
        found = self._find(here, group, name)
        if found is None:
            raise NoTwin(reason=f"the twin has no {group}.{name}")
        found.with_(deadline_s=_PLACED_WITHIN_S)(*args)

    def _state(self, here: Container, group: str) -> Any:
        reader = self._find(here, group, "state")
        try:
            return None if reader is None else msgspec.to_builtins(reader())
        except TradeError:
            return None

    def _find(self, here: Container, group: str, name: str, wait_s: float = 0.0) -> Handle | None:
        """Finds a service. All services of a provider appear together, so only the first search waits."""
        try:
            return find(here, f"{group}.{name}", None, wait_s)
        except NoSuchService:
            return None

    def close(self) -> None:
        """Ends the twin and any call on it. Idempotent."""
        if process := self._process:
            process.kill()  # this also ends a running call
        with self._lock:
            self._end()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _end(self) -> None:
        container, self._container = self._container, None
        process, self._process = self._process, None
        if container is not None:
            container.close()
        if process is not None:
            process.close(gently=True)


def _is_at(wanted: Sequence[Mapping[str, Any]], actual: Any) -> bool:
    """Whether joints are at these positions."""
    try:
        pairs = zip(wanted, actual, strict=True)
        return all(abs(one["position_rad"] - other["position_rad"]) < _NEAR_RAD for one, other in pairs)
    except (TypeError, KeyError, ValueError):
        return False


def _called(handle: Handle, args: Any, deadline_s: float) -> Any:
    called = handle.with_(deadline_s=deadline_s)
    if isinstance(args, Mapping):
        return called(**cast("Mapping[str, Any]", args))
    return called(*cast("Sequence[Any]", args))
