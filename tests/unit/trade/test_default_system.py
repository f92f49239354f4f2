"""The default system has one name for a user of a host, and an e-stop of an earlier name stays open (S09, S21)."""

import os
import socket
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from trade import Container, Settings, service, where
from trade.default_system import default_system, is_of_user, take_over
from trade.errors import Stopped
from trade.testing import Network
from trade.transport.memory import MemoryTransport
from trade_drivers.bus._angle_store import AngleStore

pytestmark = pytest.mark.virtual_time

MACHINE = "0123456789abcdef0123456789abcdef"


class Axis:
    def __init__(self) -> None:
        self.moves = 0

    @service
    def move_to(self, angle_rad: float) -> float:
        self.moves += 1
        return angle_rad

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file with the host's machine id."""
    file = tmp_path / "machine-id"
    file.write_text(f"{MACHINE}\n")
    monkeypatch.setattr("trade.default_system._MACHINE_IDS", (file,))
    return file


def named(state: Path, **environment: str) -> Settings:
    return Settings.read(container="rosie", environment={"TRADE_STATE_DIR": str(state), **environment})


@contextmanager
def robot(settings: Settings) -> Generator[tuple[Container, Axis]]:
    with Container(settings, transport=MemoryTransport(Network(), settings.container)) as container:
        container.register(axis := Axis(), "rosie.head")
        yield container, axis


def move(container: Container) -> object:
    return container.find(where(name="move_to"))(0.3)


@pytest.mark.parametrize(
    "environment",
    [{"USER": "anna"}, {"LOGNAME": "anna"}, {"HOME": "/nowhere"}, {"HOSTNAME": "other"}, {"SUDO_USER": "anna"}],
    ids=lambda one: next(iter(one)),
)
def test_S21_the_default_system_does_not_depend_on_the_environment(
    machine: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = Settings.read(environment={})
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    after = Settings.read(environment=dict(os.environ) | {"TRADE_SYSTEM": ""})
    assert (after.system, after.identity) == (before.system, before.identity)
    assert after.system.startswith(f"user{os.getuid()}-")
    assert machine.read_text().strip() not in after.system


def test_S21_the_default_system_stays_when_the_host_is_renamed(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = default_system()
    monkeypatch.setattr(socket, "gethostname", lambda: "renamed")
    assert default_system() == before
    machine.write_text(f"{MACHINE[::-1]}\n")  # control: another host
    assert default_system() != before


@pytest.mark.parametrize("text", [None, "", "uninitialized\n", "0" * 32, "no id", "\xff"])
def test_S21_a_host_without_a_machine_id_has_a_default_system(machine: Path, text: str | None) -> None:
    machine.unlink()
    if text is not None:
        machine.write_bytes(text.encode("latin-1"))
    assert default_system() == f"user{os.getuid()}-local"


def test_S21_another_user_has_another_default_system(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = default_system()
    other = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: other)
    assert default_system() != before
    assert not is_of_user(before)


@pytest.mark.parametrize(
    "earlier", ["tom@oldname", "tom@oldname as anna", "user{uid}-local", "user{uid}-ffffffff", "the same as anna"]
)
def test_S09_an_open_estop_of_an_earlier_name_latches_and_is_cleared_there_too(
    machine: Path, tmp_path: Path, earlier: str
) -> None:
    """After a restart under a new host name, or after ``USER`` had another value."""
    settings = named(tmp_path / "state")
    system, _, identity = earlier.format(uid=os.getuid()).partition(" as ")
    name = settings.system if system == "the same" else system
    folder = tmp_path / "state" / name / "estop" / (identity or settings.identity) / "rosie"
    folder.mkdir(parents=True)
    (folder / "abc.json").write_text('["abc", "anna/desk/e1", "spill", 1.5]')
    with robot(settings) as (container, axis):
        with pytest.raises(Stopped, match="spill"):
            move(container)
        assert axis.moves == 0
        assert container.estop_clear(["abc"]).complete
        assert move(container) == 0.3
    assert not list(tmp_path.rglob("abc.json"))
    with robot(settings) as (container, _):
        assert move(container) == 0.3


def test_S09_an_open_estop_of_another_container_or_user_does_not_latch(machine: Path, tmp_path: Path) -> None:
    """The control: notes belong to one container of one user."""
    settings = named(tmp_path / "state")
    for place in (
        "tom@oldname/estop/tom/other",
        f"user{os.getuid() + 1}-ffffffff/estop/tom/rosie",
        "lab/estop/tom/rosie",
    ):
        folder = tmp_path / "state" / place
        folder.mkdir(parents=True)
        (folder / "abc.json").write_text('["abc", "anna/desk/e1", "spill", 1.5]')
    with robot(settings) as (container, _):
        assert move(container) == 0.3
    assert len(list(tmp_path.rglob("abc.json"))) == 3


def test_S09_an_explicit_system_has_no_earlier_names(machine: Path, tmp_path: Path) -> None:
    folder = tmp_path / "state" / "tom@oldname" / "estop" / "tom" / "rosie"
    folder.mkdir(parents=True)
    (folder / "abc.json").write_text('["abc", "anna/desk/e1", "spill", 1.5]')
    with robot(named(tmp_path / "state", TRADE_SYSTEM="lab")) as (container, _):
        assert move(container) == 0.3


@pytest.mark.parametrize("variable", ["HOME", "XDG_STATE_HOME"])
def test_S09_an_open_estop_latches_whatever_home_the_environment_names(
    machine: Path, tmp_path: Path, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot runs under ``sudo -E``, or a shell names another folder; it starts again without that."""
    account, other = tmp_path / "account", tmp_path / "other"
    account.mkdir()
    monkeypatch.setattr("trade._settings.account_home", lambda: account)

    def settings(home: Path) -> Settings:
        monkeypatch.setenv("HOME", str(home if variable == "HOME" else account))
        return Settings.read(
            container="rosie",
            environment={"XDG_STATE_HOME": str(home)} if variable != "HOME" and home != account else {},
        )

    for first, second in ((account, other), (other, account)):
        with robot(settings(first)) as (container, _):
            estop = container.estop("spill", limit_s=30).id
        with robot(settings(second)) as (container, axis):
            with pytest.raises(Stopped, match="spill"):
                move(container)
            assert axis.moves == 0
            assert container.estop_clear([estop], limit_s=30).complete
        with robot(settings(second)) as (container, _):
            assert move(container) == 0.3


@pytest.mark.parametrize("folder", ["user{uid}-ffffffff", "lab"])
def test_S23_last_known_angles_of_an_earlier_name_are_taken_over(tmp_path: Path, folder: str) -> None:
    """Without them, a zero that was lost with power would not be noticed. An explicit system takes nothing over."""
    own = tmp_path / folder.format(uid=os.getuid())
    for name, angle in (("tom@oldest", 1.0), ("tom@newest", 2.0)):
        store = AngleStore(tmp_path / name / "angles" / "rosie.sqlite", print)
        assert store.save({"rosie.pan": (angle, angle)}).result()
        store.close()
    os.utime(tmp_path / "tom@oldest" / "angles" / "rosie.sqlite", (1, 1))
    for _ in range(2):  # the second time, it exists, and stays
        take_over(own, "angles/rosie.sqlite")
        store = AngleStore(own / "angles" / "rosie.sqlite", print)
        assert store.load() == ({} if folder == "lab" else {"rosie.pan": (2.0, 2.0)})
        store.close()
        os.utime(tmp_path / "tom@oldest" / "angles" / "rosie.sqlite")
