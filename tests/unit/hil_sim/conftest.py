"""A simulated bus in this process, an injected clock, and the vendor's client opened on it."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dynamixel_sdk
import pytest

from tests.support.simulated_robots import HEAD_AND_ARM
from tests.unit.hil_sim.drive_bench import Bench
from trade_hil_sim import DynamixelBus, Servo


class FakeClock:
    """Seconds that pass when a test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def advance(self, s: float) -> float:
        self.now += s
        return self.now


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def make_bus(tmp_path: Path) -> Iterator[Callable[..., DynamixelBus]]:
    """Opens buses with ids or servos on them; unpaced unless asked."""
    opened: list[DynamixelBus] = []

    def make(*servos: int | Servo, paced: bool = False, **options: Any) -> DynamixelBus:
        now = options.get("clock", time.monotonic)()
        made = [Servo(s, t=now) if isinstance(s, int) else s for s in servos]
        bus = DynamixelBus(made, tmp_path / f"bus{len(opened)}", paced=paced, **options)
        opened.append(bus.open())
        return bus

    yield make
    for bus in opened:
        bus.close()


@pytest.fixture
def bus(make_bus: Callable[..., DynamixelBus]) -> DynamixelBus:
    """Servos 1, 2 and 3."""
    return make_bus(1, 2, 3)


@pytest.fixture
def open_sdk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., SimpleNamespace]]:
    """Opens the vendor's library, unmodified, on a bus: ``sdk.port``, ``sdk.ph``."""
    # the library's own dial for slow adapters: simulator and client share two cores and one interpreter here
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 100)
    opened: list[dynamixel_sdk.PortHandler] = []

    def open_(bus: DynamixelBus, baud: int = 1_000_000) -> SimpleNamespace:
        port = dynamixel_sdk.PortHandler(str(bus.port))
        assert port.openPort()
        opened.append(port)
        assert port.setBaudRate(baud)
        return SimpleNamespace(port=port, ph=dynamixel_sdk.PacketHandler(2.0))

    yield open_
    for port in opened:
        port.closePort()


@pytest.fixture
def sdk(bus: DynamixelBus, open_sdk: Callable[..., SimpleNamespace]) -> SimpleNamespace:
    """The vendor's library on `bus`."""
    return open_sdk(bus)


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    path = tmp_path / "rosie.toml"
    path.write_text(HEAD_AND_ARM)
    return path


@pytest.fixture
def bench() -> Bench:
    """A drive at rest, without power."""
    return Bench()
