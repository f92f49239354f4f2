"""What a container writes down of what happens in it: who called, locked, stopped, was refused, changed its set-up."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trade import Container, Resource, Secret, Settings, service, where
from trade._audit.store import reading
from trade._services.local_service import LocalService
from trade.auditing import AuditRow, verify
from trade.errors import AccessDenied, ConfigurationError, InvalidArgument, LockedByOther, LockLost, Stopped

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]
Start = Callable[..., Container]


class Arm:
    def __init__(self) -> None:
        self.resources = (Resource("rosie.arm"),)

    @service
    def reach(self, angle_rad: float) -> float:
        if angle_rad > 1:
            raise ValueError("swordfish is the word")
        return angle_rad

    @service
    def unlock_with(self, word: Secret[str]) -> None:
        raise AccessDenied(who="x", verb="call", what=word, rule="none")

    @service(effect="read")
    def angle(self) -> float:
        return 0.5

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "audit"


@pytest.fixture
def there(start_container: Start, folder: Path) -> Container:
    container = start_container("there", audit=folder)
    container.register(Arm(), "rosie.arm")
    return container


def call(here: Container, name: str, *args: Any) -> Any:
    return here.find(where(name=name, group="rosie.arm"), wait_s=20)(*args)


def rows(container: Container, folder: Path) -> list[AuditRow]:
    """What it wrote, all of it: closed, so that nothing waits."""
    container.close()
    with reading(folder / f"{container.name}.sqlite") as (head, links):
        found = list(links)
    assert verify(found, head).problem == ""
    return [link.row for link in found]


def reported(container: Container, folder: Path) -> list[tuple[str, str, str]]:
    return [(row.kind, row.what, row.outcome) for row in rows(container, folder) if row.kind != "audit"]


def test_a_call_is_written_down_with_who_made_it_and_by_which_id(
    here: Container, there: Container, folder: Path
) -> None:
    there.set_tracing(True)
    assert call(here, "reach", 0.5) == 0.5
    [span] = [span for span in there.spans() if (span.service, span.side) == ("rosie.arm.reach", "served")]
    [row] = [row for row in rows(there, folder) if row.kind == "call"]
    assert (row.what, row.outcome, row.who, row.session) == (
        "rosie.arm.reach",
        "ok",
        here.address.identity,
        str(here.address),
    )
    assert row.call_id == span.call_id
    assert 0 < row.took_ns < 60 * 10**9
    assert row.boot == there.address.epoch


class Mind:
    def __init__(self, home: Container) -> None:
        self._home = home

    @service
    def plan(self, angle_rad: float) -> float:
        return call(self._home, "reach", angle_rad)


def test_what_comes_of_a_call_has_the_id_of_the_one_that_began_it_all_in_every_record(
    here: Container, there: Container, folder: Path, start_container: Start
) -> None:
    between = start_container("between", audit=folder)
    between.register(Mind(between), "rosie.mind")
    plan = here.find(where(name="plan"), wait_s=20)
    plan(0.5)
    with there.lock(where(group="rosie.arm")), pytest.raises(LockedByOther):
        plan(0.5)
    planned = [row for row in rows(between, folder) if row.what == "rosie.mind.plan"]
    reached = [row for row in rows(there, folder) if row.what == "rosie.arm.reach"]
    assert [row.kind for row in reached] == ["call", "refused"]
    assert [row.outer_id for row in planned] == [row.call_id for row in planned]
    assert [row.outer_id for row in reached] == [row.call_id for row in planned]
    assert {row.call_id for row in reached}.isdisjoint(row.call_id for row in planned)


def test_a_call_within_the_container_is_written_down_too(there: Container, folder: Path) -> None:
    call(there, "reach", 0.5)
    assert ("call", "rosie.arm.reach", "ok") in reported(there, folder)


def test_the_audit_record_names_an_error_without_its_message(here: Container, there: Container, folder: Path) -> None:
    with pytest.raises(ValueError, match="swordfish"):
        call(here, "reach", 2.0)
    [row] = [row for row in rows(there, folder) if row.kind == "call"]
    assert (row.outcome, row.why) == ("ValueError", "")


def test_what_is_secret_is_in_no_record(here: Container, there: Container, folder: Path) -> None:
    with pytest.raises(AccessDenied):
        call(here, "unlock_with", "swordfish")
    [row] = [row for row in rows(there, folder) if row.kind == "refused"]
    assert (row.outcome, row.why) == ("AccessDenied", "")
    assert b"swordfish" not in (folder / "there.sqlite").read_bytes()


def test_reads_are_written_down_only_if_asked_for(here: Container, there: Container, folder: Path) -> None:
    call(here, "angle")
    here.containers()
    assert reported(there, folder) == []


def test_reads_that_are_asked_for_are_written_down(
    here: Container, start_container: Start, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRADE_AUDIT_READS", "1")
    there = start_container("there", audit=folder)
    there.register(Arm(), "rosie.arm")
    call(here, "angle")
    assert ("read", "rosie.arm.angle", "ok") in reported(there, folder)


def test_wrong_arguments_are_a_refusal(here: Container, there: Container, folder: Path) -> None:
    with pytest.raises(InvalidArgument):
        call(here, "reach", "far")
    assert reported(there, folder) == [("refused", "rosie.arm.reach", "InvalidArgument")]


def test_grants_and_refusals_of_locks_are_written_down(
    here: Container, there: Container, start_container: Start, folder: Path
) -> None:
    other = start_container("other")
    here.find(where(name="reach"), wait_s=20)
    with here.lock(where(group="rosie.arm"), purpose="grasping"):
        with pytest.raises(LockedByOther):
            call(other, "reach", 0.5)
        with pytest.raises(LockedByOther):
            other.lock(where(group="rosie.arm"), wait_s=0).acquire()
    found = rows(there, folder)
    assert [(row.kind, row.what, row.outcome) for row in found if row.kind in ("lock", "refused")] == [
        ("lock", "locked", "ok"),
        ("refused", "rosie.arm.reach", "LockedByOther"),
        ("refused", "trade.acquire", "LockedByOther"),
        ("lock", "unlocked", "ok"),
    ]
    locked = next(row for row in found if row.what == "locked")
    assert (locked.about, locked.why, locked.session) == ("rosie.arm", "for grasping", str(here.address))
    refused = [row for row in found if row.kind == "refused"]
    assert {row.session for row in refused} == {str(other.address)}
    assert refused[1].about == "rosie.arm"
    assert "grasping" in refused[0].why


def test_a_lock_that_is_taken_away_says_by_whom(here: Container, there: Container, folder: Path) -> None:
    here.find(where(name="reach"), wait_s=20)
    with pytest.raises(LockLost), here.lock(where(group="rosie.arm")):
        there.break_lock(where(group="rosie.arm"), "the door is open")
    found = [(row.what, row.session, row.why) for row in rows(there, folder) if row.kind == "lock"]
    assert found[1] == (
        "lock lost",
        str(here.address),
        f"broken by {there.address.identity}: the door is open",
    )
    assert found[2][:2] == ("trade.break_lock", str(there.address))


def test_stops_and_e_stops_are_written_down_once_each_and_so_is_who_clears_them(
    here: Container, there: Container, folder: Path
) -> None:
    call(here, "stop")
    report = here.estop("a hand in the gripper")
    with pytest.raises(Stopped):
        call(here, "reach", 0.5)
    here.estop_clear([report.id])
    found = rows(there, folder)
    assert [(row.kind, row.what, row.outcome) for row in found if row.kind in ("stop", "refused")] == [
        ("stop", "rosie.arm.stop", "ok"),
        ("stop", "e-stop", "ok"),
        ("refused", "rosie.arm.reach", "Stopped"),
        ("stop", "e-stop cleared", "ok"),
    ]
    given = next(row for row in found if row.what == "e-stop")
    assert (given.about, given.session, given.why) == (report.id, str(here.address), "a hand in the gripper")
    assert next(row for row in found if row.what == "e-stop cleared").who == here.address.identity


def test_a_lock_whose_owner_is_gone_ends_once_in_the_record(
    start_container: Start, there: Container, folder: Path, eventually: Eventually
) -> None:
    here = start_container("here")
    here.find(where(name="reach"), wait_s=20)
    with here.open_session("page"):
        lock = here.lock(where(group="rosie.arm"))
        lock.acquire()
    here.close()
    assert eventually(lambda: not there.locks())
    found = [row for row in rows(there, folder) if row.what in ("lock lost", "unlocked")]
    assert len(found) == 1


def test_changes_of_the_set_up_are_written_down_with_what_was_changed(
    here: Container, there: Container, folder: Path, tmp_path: Path
) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(
        '[roles.all]\nread = ["*"]\ncall = ["*"]\nadminister = ["*"]\ninstrument = ["*"]\n'
        f'[identities]\n"{there.address.identity}" = ["all"]\n'
    )
    there.load_policy(policy)
    here.find(where(name="load_policy", container="there"), wait_s=20)(str(policy))
    with pytest.raises(ConfigurationError):
        here.call(where(name="load_policy", container="there"), str(tmp_path / "none.toml"))
    here.call(where(name="set_tracing", container="there"), True)
    there.note_change("a file was read", "rosie.toml")
    found = [(row.what, row.about, row.session, row.outcome) for row in rows(there, folder) if row.kind == "configure"]
    own, asked = str(there.address), str(here.address)
    assert found == [
        ("policy loaded", str(policy), own, "ok"),
        ("policy loaded", str(policy), asked, "ok"),
        ("trade.load_policy", str(policy), asked, "ok"),
        ("trade.load_policy", str(tmp_path / "none.toml"), asked, "ConfigurationError"),
        ("trade.set_tracing", "True", asked, "ok"),
        ("a file was read", "rosie.toml", own, "ok"),
    ]


def test_a_refusal_is_in_the_record_of_the_refusing_container_with_its_rule(
    start_container: Start, there: Container, folder: Path, tmp_path: Path
) -> None:
    here = start_container("here", audit=folder)
    here.find(where(name="reach"), wait_s=20)
    policy = tmp_path / "policy.toml"
    policy.write_text(
        f'[roles.viewer]\nread = ["*"]\nregister = ["*"]\n[identities]\n"{there.address.identity}" = ["viewer"]\n'
    )
    there.load_policy(policy)
    with pytest.raises(AccessDenied):
        call(here, "reach", 0.5)
    here.load_policy(policy)
    with pytest.raises(AccessDenied):
        call(here, "reach", 0.5)
    for container in (there, here):
        [row] = [row for row in rows(container, folder) if row.kind == "refused"]
        assert (row.what, row.outcome, row.session) == ("rosie.arm.reach", "AccessDenied", str(here.address))
        assert "call" in row.why


def test_hooks_and_tracing_leave_a_record_as_it_is(here: Container, there: Container, folder: Path) -> None:
    there.set_tracing(True)
    call(here, "reach", 0.5)
    there.set_tracing(False)
    call(here, "reach", 0.5)
    assert [one for one in reported(there, folder) if one[0] == "call"] == [("call", "rosie.arm.reach", "ok")] * 2


def test_a_disabled_audit_record_adds_no_interceptor_and_no_file(
    here: Container, start_container: Start, tmp_path: Path
) -> None:
    there = start_container("there")
    there.register(Arm(), "rosie.arm")
    handle = here.find(where(name="reach"), wait_s=20)
    served: LocalService | None = there._parts.providers.service(handle.key)
    assert served is not None
    handle(0.5)
    assert served.interceptors == ()
    assert list(tmp_path.glob("**/*.sqlite")) == []


@pytest.mark.realtime
def test_without_a_record_the_core_loads_no_database() -> None:
    program = "import sys, trade; sys.exit('sqlite3' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("TRADE_AUDIT_KEEP_DAYS", "ninety", "is no whole number"),
        ("TRADE_AUDIT_KEEP_DAYS", "0", "must be from 1"),
        ("TRADE_AUDIT_KEEP_ROWS", "-5", "must be from 1"),
    ],
)
def test_limits_that_make_no_sense_are_refused(name: str, value: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{name}.*{says}"):
        Settings.read(environment={name: value})


def test_the_environment_says_where_and_how_long(tmp_path: Path) -> None:
    settings = Settings.read(
        environment={"TRADE_AUDIT": str(tmp_path), "TRADE_AUDIT_KEEP_DAYS": "7", "TRADE_AUDIT_KEEP_ROWS": "50"}
    )
    assert (settings.audit, settings.audit_keep_days, settings.audit_keep_rows) == (tmp_path, 7, 50)
