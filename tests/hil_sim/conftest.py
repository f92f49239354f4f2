"""A simulated bus in this process, an injected clock, and the vendor's client opened on it."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import dynamixel_sdk
import pytest

from trade_hil_sim import DynamixelBus, Servo

ROBOT = """
[robot]
name = "rosie"

[bus.neck]
driver = "dynamixel"
port = "/dev/ttyUSB0"

[bus.arm]
driver = "dynamixel"
port = "/dev/ttyUSB1"
baud = 57600

[joint."neck.pan"]
bus = "neck"
id = 1
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[joint."neck.tilt"]
bus = "neck"
id = 2
model = "XL430-W250"
reversed = true
offset_rad = 0.5
min_rad = -0.6
max_rad = 0.6
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0

[joint.elbow]
bus = "arm"
id = 3
model = "XM430-W350"
min_rad = 0.25
max_rad = 1.0
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""


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


class WaitUntil(Protocol):
    def __call__(self, condition: Callable[[], Any], what: str = "") -> None: ...


@pytest.fixture
def wait_until() -> WaitUntil:
    def wait(condition: Callable[[], Any], what: str = "the condition") -> None:
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not come"
            time.sleep(0.001)

    return wait


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
    path.write_text(ROBOT)
    return path
