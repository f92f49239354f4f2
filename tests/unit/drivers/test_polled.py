"""Polled sensors: the owner of the wire, the age of readings, silence and return."""

import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from trade.errors import BusGone, ConfigurationError, DeviceSilent
from trade_drivers import Measured, PolledSensor, SensorInfo
from trade_drivers.testing import SensorContract

pytestmark = pytest.mark.virtual_time

INFO = SensorInfo(name="rosie.scale", model="S1", unit="kg", size=0, low=0.0, high=5.0, rate_hz=100.0)


class Scale(PolledSensor):
    """Weighs one kilogramme more each time it is asked, up to five."""

    def __init__(self, stale_after_s: float = 0.5) -> None:
        super().__init__(INFO, "/dev/scale", stale_after_s=stale_after_s)
        self.asked = 0
        self.opened = 0
        self.is_open = False
        self.threads: set[str] = set()
        self.trouble: BaseException | None = None
        self.missing: BaseException | None = None

    def open(self) -> None:
        if self.missing is not None:
            raise self.missing
        self.opened += 1
        self.is_open = True

    def measure(self) -> Measured:
        assert self.is_open, "a wire that was let go of is not asked"
        self.threads.add(threading.current_thread().name)
        if self.trouble is not None:
            raise self.trouble
        self.asked += 1
        return Measured(float(min(5, self.asked)), "doubtful" if self.asked > 5 else "good")

    def hang_up(self) -> None:
        self.is_open = False


@pytest.fixture
def start() -> Iterator[Callable[[Scale], Scale]]:
    with ExitStack() as undo:

        def started(scale: Scale) -> Scale:
            undo.callback(scale.close)
            return scale.start("kitchen.toml: sensor.scale.port")

        yield started


@pytest.fixture
def scale(start: Callable[[Scale], Scale]) -> Scale:
    return start(Scale())


class TestScale(SensorContract):
    @pytest.fixture
    def sensor(self, scale: Scale) -> Scale:
        return scale


def test_there_is_a_reading_as_soon_as_it_is_started(start: Callable[[Scale], Scale]) -> None:
    assert start(Scale()).read().unit == "kg"


def test_readers_never_touch_the_wire(scale: Scale) -> None:
    asked = scale.asked
    readings = [scale.read() for _ in range(5000)]
    assert scale.asked - asked < len(readings)
    wait_until(lambda: scale.asked > asked + 1, "its thread continues")
    assert scale.threads == {threading.current_thread().name, "sensor rosie.scale"}, "the first, and all others"


def test_what_the_device_does_not_vouch_for_says_so(scale: Scale) -> None:
    wait_until(lambda: scale.read().quality == "doubtful", "it has more than it can weigh")


TROUBLES = [OSError("cable"), ValueError("noise"), termios.error(5, "gone"), RuntimeError("a mistake of the driver's")]


@pytest.mark.parametrize("trouble", TROUBLES, ids=lambda trouble: type(trouble).__name__)
def test_whatever_measuring_raises_it_is_silent_until_it_is_back(
    start: Callable[[Scale], Scale], trouble: BaseException
) -> None:
    scale = start(Scale(stale_after_s=0.1))
    scale.trouble = trouble
    wait_until(lambda: _is_silent(scale), "the last reading is too old")
    scale.trouble = None
    wait_until(lambda: not _is_silent(scale), "it is back")
    assert scale.opened >= 2, "its wire was opened again"


def test_a_lost_port_is_reported_with_the_reason(start: Callable[[Scale], Scale]) -> None:
    scale = start(Scale(stale_after_s=0.1))
    scale.missing = FileNotFoundError("no such port")
    scale.trouble = OSError("cable")

    def gone() -> bool:
        try:
            scale.read()
        except BusGone as error:
            return error.reason == "no such port"
        except DeviceSilent:
            return False
        return False

    wait_until(gone, "it says why")
    scale.missing = scale.trouble = None
    wait_until(lambda: not _is_silent(scale), "it is back")


@pytest.mark.parametrize("kind", ["trouble", "missing"])
def test_one_that_cannot_be_measured_is_not_attached_and_its_wire_is_free(kind: str) -> None:
    scale = Scale()
    setattr(scale, kind, termios.error(25, "Inappropriate ioctl for device"))
    with pytest.raises(ConfigurationError, match=r"kitchen\.toml: sensor\.scale\.port: /dev/scale: .*Inappropriate"):
        scale.start("kitchen.toml: sensor.scale.port")
    assert not scale.is_open
    scale.close()


def test_closing_releases_the_wire(scale: Scale) -> None:
    scale.close()
    assert not scale.is_open
    scale.close()


def _is_silent(scale: Scale) -> bool:
    try:
        scale.read()
    except DeviceSilent:
        return True
    return False
