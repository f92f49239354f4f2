"""``trade audit``: what is in the records of a folder, in order; and whether each row is still what it was."""

import json
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs
from typer.testing import CliRunner

from trade._audit.hash_chain import AuditRow
from trade._audit.store import AuditStore, Retention
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.cli import app

pytestmark = pytest.mark.virtual_time


def trade(*words: str | Path) -> Any:
    return CliRunner().invoke(app, [str(word) for word in words])


def lines(*words: str | Path) -> list[dict[str, Any]]:
    done = trade(*words, "--json")
    return [json.loads(line) for line in done.stdout.splitlines()]


def whats(*words: str | Path) -> list[str]:
    return [line["what"] for line in lines("audit", *words)]


def row(what: str, at_s: float, **other: Any) -> AuditRow:
    fields = {"kind": "call", "who": "anna", "call_id": 7, "outer_id": 7, "outcome": "ok", "why": "", **other}
    kind, who, call_id, outer_id, outcome, why = fields.values()
    at_ns = int(at_s * 1e9)
    return AuditRow(0, at_ns, 1, "boot", kind, what, "", who, "anna/mind/1", call_id, outer_id, outcome, why, 5)


def write(path: Path, rows: Sequence[AuditRow]) -> None:
    store = AuditStore(path)
    store.add(rows)
    store.close()


def do(path: Path, statement: str) -> None:
    file = sqlite3.connect(path)
    with file:
        file.execute(statement)
    file.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    now, found = time.time(), tmp_path / "audit"
    arm = [
        row("rosie.arm.reach", now - 7200),
        row("rosie.arm.grip", now - 60, who="berta"),
        row("rosie.arm.grip", now - 30, kind="refused", outcome="AccessDenied", why="no rule gives berta [call]"),
    ]
    write(found / "arm.sqlite", arm)
    write(found / "neck.sqlite", [row("rosie.neck.look", now - 3600), row("rosie.neck.nod", now - 45)])
    return found


def test_the_records_of_all_containers_are_shown_in_order_of_time(folder: Path) -> None:
    assert whats(folder) == [
        "rosie.arm.reach",
        "rosie.neck.look",
        "rosie.arm.grip",
        "rosie.neck.nod",
        "rosie.arm.grip",
    ]
    last = trade("audit", folder).stdout.splitlines()[-1]
    assert "refused   arm: anna rosie.arm.grip AccessDenied: no rule gives berta [call]  (call 7)" in last


def test_clients_of_an_http_gateway_are_shown_and_found_by_name(tmp_path: Path) -> None:
    by_anna = structs.replace(row("rosie.neck.look", time.time(), who="page"), session="page/door/1f/anna.6")
    write(tmp_path / "neck.sqlite", [by_anna, structs.replace(by_anna, session="page/door/1f/bert.7")])
    shown = trade("audit", tmp_path, "--who", "anna").stdout.splitlines()
    assert len(shown) == 1
    assert "neck: page for anna rosie.neck.look" in shown[0]
    assert len(whats(tmp_path, "--who", "page")) == 2
    assert whats(tmp_path, "--who", "carl") == []


def test_the_folder_of_the_containers_is_the_one_that_is_meant(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_AUDIT", str(folder))
    assert len(whats()) == 5
    assert len(whats("--since", "1m")) == 2


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--since", "90m"], 4),
        (["--since", "2001-09-09T03:46"], 5),
        (["--who", "ber*"], 1),
        (["--service", "rosie.neck.*"], 2),
        (["--container", "arm"], 3),
        (["--kind", "refused"], 1),
        (["--kind", "lock"], 0),
        (["--since", "90m", "--service", "*.grip", "--kind", "call"], 1),
    ],
)
def test_records_can_be_filtered(folder: Path, words: list[str], found: int) -> None:
    assert len(whats(folder, *words)) == found


def test_everything_a_call_led_to_is_found_by_its_id_and_by_the_ids_of_nested_calls(folder: Path) -> None:
    write(folder / "mind.sqlite", [row("rosie.mind.plan", time.time() - 50, call_id=30, outer_id=30)])
    write(folder / "neck.sqlite", [row("rosie.neck.turn", time.time() - 49, call_id=41, outer_id=30)])
    assert whats(folder, "--call", "30") == ["rosie.mind.plan", "rosie.neck.turn"]
    assert whats(folder, "--call", "41") == ["rosie.neck.turn"]
    said = trade("audit", folder, "--call", "41").stdout
    assert "(call 41 of 30)" in said


def test_an_invalid_time_is_refused(folder: Path) -> None:
    done = trade("audit", folder, "--since", "yesterday")
    assert isinstance(done.exception, UsageError)
    assert "yesterday" in str(done.exception)


def test_a_folder_without_records_is_no_empty_record(tmp_path: Path) -> None:
    for words in (["audit"], ["audit", "verify"], ["audit", "head"]):
        done = trade(*words, tmp_path / "nothing")
        assert isinstance(done.exception, ConfigurationError)
        assert "TRADE_AUDIT" in str(done.exception)


def test_a_record_that_is_whole_verifies(folder: Path) -> None:
    done = trade("audit", "verify", folder)
    assert done.exit_code == 0
    assert "arm: 3 rows" in done.stdout
    assert [line["ok"] for line in lines("audit", "verify", folder)] == [True, True]


@pytest.mark.parametrize(
    ("statement", "at"),
    [
        ("UPDATE record SET who = 'anna' WHERE seq = 2", 2),
        ("DELETE FROM record WHERE seq = 2", 2),
        ("DELETE FROM record WHERE seq = 3", 3),
        ("UPDATE record SET seq = CASE seq WHEN 2 THEN -3 ELSE -2 END WHERE seq > 1", 2),
        ("DROP TABLE record", 1),
    ],
)
def test_one_that_is_not_ends_with_exit_code_1_and_names_the_row(folder: Path, statement: str, at: int) -> None:
    do(folder / "arm.sqlite", statement)
    assert trade("audit", "verify", folder).exit_code == 1
    arm, neck = lines("audit", "verify", folder)
    assert (arm["container"], arm["ok"], arm["broken_at"]) == ("arm", False, at)
    assert neck["ok"]


def test_rows_in_another_order_are_found(folder: Path) -> None:
    for statement in ("UPDATE record SET seq = -seq WHERE seq > 1", "UPDATE record SET seq = 5 + seq WHERE seq < 0"):
        do(folder / "arm.sqlite", statement)
    done = trade("audit", "verify", folder)
    assert done.exit_code == 1
    assert "row 2: it was row 3" in done.stdout


def test_a_file_that_is_no_record_does_not_verify(folder: Path) -> None:
    (folder / "arm.sqlite").write_bytes(b"something else" * 1000)
    done = trade("audit", "verify", folder)
    assert done.exit_code == 1
    assert "cannot be read" in done.stdout
    assert whats(folder) == ["rosie.neck.look", "rosie.neck.nod"]


def test_a_record_that_was_moved_aside_is_not_passed_over(folder: Path) -> None:
    (folder / "arm.sqlite").rename(folder / "arm.sqlite.broken-17")
    done = trade("audit", "verify", folder)
    assert done.exit_code == 1
    assert "arm.sqlite.broken-17" in done.stdout


def test_heads_noted_elsewhere_detect_a_rewritten_record(folder: Path, tmp_path: Path) -> None:
    noted = tmp_path / "heads"
    noted.write_text(trade("audit", "head", folder, "--json").stdout)
    write(folder / "arm.sqlite", [row("rosie.arm.later", time.time())])
    assert trade("audit", "verify", folder, "--against", noted).exit_code == 0
    (folder / "arm.sqlite").unlink()
    write(folder / "arm.sqlite", [row("rosie.arm.nothing", 1) for _ in range(9)])
    assert trade("audit", "verify", folder).exit_code == 0
    done = trade("audit", "verify", folder, "--against", noted)
    assert done.exit_code == 1
    assert "arm: row 3" in done.stdout
    (folder / "neck.sqlite").unlink()
    assert "neck: noted elsewhere" in trade("audit", "verify", folder, "--against", noted).stdout


def test_a_noted_head_that_was_dropped_since_is_said_to_prove_nothing(folder: Path, tmp_path: Path) -> None:
    noted = tmp_path / "heads"
    noted.write_text(trade("audit", "head", folder, "--json").stdout)
    store = AuditStore(folder / "arm.sqlite")
    store.add([row("rosie.arm.later", time.time()) for _ in range(5)])
    assert store.drop(Retention(days=1, rows=2, least=0, piece=6), row("", time.time())) == 6
    store.close()
    done = trade("audit", "verify", folder, "--against", noted)
    assert done.exit_code == 3
    assert "arm: 3 rows, each follows from the one before; rows before 7 were dropped in order" in done.stdout
    assert "arm: row 3 was noted elsewhere and dropped since, so it cannot be compared" in done.stdout
    arm, neck = lines("audit", "verify", folder, "--against", noted)
    assert (arm["ok"], arm["untold"], arm["proven"]) == (True, [3], 0)
    assert (neck["ok"], neck["untold"], neck["proven"]) == (True, [], 2)
    noted.write_text(noted.read_text() + trade("audit", "head", folder, "--json").stdout)
    later = trade("audit", "verify", folder, "--against", noted)
    assert later.exit_code == 0
    assert "cannot be compared" in later.stdout


def test_an_invalid_file_of_saved_heads_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "heads").write_text("arm 3\n")
    done = trade("audit", "verify", folder, "--against", tmp_path / "heads")
    assert isinstance(done.exception, UsageError)
