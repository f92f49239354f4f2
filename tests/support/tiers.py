"""Three tiers of tests, by what a test may use; refuses in each tier what belongs below it.

`make test` decides whether a change lands, so none of its tests depends on how fast the computer is. A test that needs
more says so with a marker, or is in a folder that says so for it:

- no marker: code, containers and zenoh within the process. Waits end by a condition.
- `virtual_time`: also simulated devices, as their time is virtual. With `--real-time`, these tests are `realtime`.
- `real_clock`: as without a marker, where the module is on virtual time.
- `realtime`: simulators on real clocks, child processes, programs of other people.
- `system`: also network namespaces, browsers and other toolchains.

The refusal names what the test did. A refused operation does not happen.
"""

import multiprocessing.util
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

_ROOT: Final = Path(__file__).parents[2]
_SYSTEM_FOLDERS: Final = (
    "tests/bench",
    "tests/endurance/chaos",
    "tests/endurance/soak",
    "tests/release",
    "tests/system",
)
_LONGEST_S: Final = 2.0
"""How long a test of the first tier should take; longer ones are listed, as a busy computer must not fail them."""
_LONG: Final = "longer than its tier allows"
_PROCESSES: Final = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system"}
_BROWSERS: Final = ("chromium", "chromedriver", "google-chrome")


class TierViolation(RuntimeError):
    """A test did what its tier does not allow; the message names the marker that allows it."""


class _Guard:
    """What the running test must not do, and what of that it tried."""

    def __init__(self) -> None:
        self._tier: str | None = None
        self._violations: list[str] = []

    def begin(self, tier: str) -> None:
        self._tier, self._violations = tier, []

    def end(self) -> list[str]:
        """What the test tried, also where the product caught the refusal."""
        self._tier = None
        return self._violations

    def refuse(self, did: str, *tiers: str) -> None:
        if self._tier not in tiers:
            return
        marker = "system" if self._tier == "realtime" else "realtime"
        self._violations.append(violation := f"this test {did}: mark it with @pytest.mark.{marker}")
        raise TierViolation(violation)


_guard: Final = _Guard()


def tier_of(item: pytest.Item) -> str:
    """`gate`, `realtime` or `system`."""
    if item.get_closest_marker("system"):
        return "system"
    return "realtime" if item.get_closest_marker("realtime") else "gate"


def _audit(event: str, args: tuple[Any, ...]) -> None:
    if event in _PROCESSES:
        words = _words(args) if event == "subprocess.Popen" else [event]
        _guard.refuse(f"starts a process ({' '.join(words)[:200]})", "gate")
        if "netns" in words:
            _guard.refuse("uses network namespaces", "realtime")
        if Path(words[0]).name.startswith(_BROWSERS):
            _guard.refuse("starts a browser", "realtime")
    elif event == "socket.bind" and _is_simulator():
        _guard.refuse(f"opens a socket of a simulator ({args[1]})", "gate")
    elif event == "open" and isinstance(args[0], str) and args[0].startswith("/dev/pts/"):
        _guard.refuse(f"opens a pseudo-terminal ({args[0]})", "gate")


def _words(args: tuple[Any, ...]) -> list[str]:
    executable, given = args[:2]
    words = [given] if isinstance(given, str | bytes | os.PathLike) else list(given or [executable])
    return [os.fsdecode(word) for word in words]


def _is_simulator() -> bool:
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("trade_hil_sim"):
            return True
        frame = frame.f_back
    return False


def _refusing(function: Callable[..., Any], did: str) -> Callable[..., Any]:
    """The function itself where it raises no audit event."""

    def refused(*args: Any) -> Any:
        _guard.refuse(did, "gate")
        return function(*args)

    return refused


def pytest_configure() -> None:
    """Called for a module that is named as a plugin."""
    os.openpty = _refusing(os.openpty, "opens a pseudo-terminal")
    spawn = multiprocessing.util.spawnv_passfds  # type: ignore[attr-defined]
    multiprocessing.util.spawnv_passfds = _refusing(spawn, "starts a process")  # type: ignore[attr-defined]
    sys.addaudithook(_audit)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what whole folders are, and what is on the real clock, before `-m` selects."""
    for item in items:
        virtual = item.get_closest_marker("virtual_time") and not item.get_closest_marker("real_clock")
        if virtual and config.getoption("--real-time", default=False):
            item.add_marker(pytest.mark.realtime)
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.real_clock)
        if in_system_folder(item.path):
            item.add_marker(pytest.mark.system)


def in_system_folder(path: Path) -> bool:
    """Whether all tests of a module are of the last tier, because of its folder."""
    return path.is_relative_to(_ROOT) and path.relative_to(_ROOT).as_posix().startswith(_SYSTEM_FOLDERS)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Guard setup, call and teardown of a test."""
    _guard.begin(tier_of(item))
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Fail a test that tried what it must not, even if the refusal was caught."""
    try:
        return (yield)
    finally:
        if violations := _guard.end():
            pytest.fail("\n".join(dict.fromkeys(violations)), pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[Any]:
    """Remember which tests of the first tier took long."""
    report = yield
    if call.duration > _LONGEST_S and tier_of(item) == "gate":
        report.user_properties.append((_LONG, call.duration))
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """List the tests that are too long for `make test`."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.stats.get(kind, [])]
    long = [(seconds, report.nodeid) for report in reports for key, seconds in report.user_properties if key == _LONG]
    if long:
        terminalreporter.section(f"longer than {_LONGEST_S:g} s: make shorter, or mark with @pytest.mark.realtime")
        for seconds, name in sorted(long, reverse=True):
            terminalreporter.line(f"{seconds:.1f} s {name}")
