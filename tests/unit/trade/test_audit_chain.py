"""The chain of a record: what is changed, removed, added, moved or cut off is found, and so is where it began."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec import structs

from trade._audit.hash_chain import NOTHING, AuditRow, ChainCheck, Head, Link, row_hash, verify
from trade._audit.store import AuditStore, Retention, reading

DAY_NS = 86_400_000_000_000


def row(what: str, at_ns: int = 1) -> AuditRow:
    return AuditRow(0, at_ns, 1, "boot", "call", what, "", "anna", "anna/mind/1", 7, 3, "ok", "", 5)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[AuditStore]:
    made = AuditStore(tmp_path / "arm.sqlite")
    made.add([row(f"rosie.step{i}") for i in range(1, 21)])
    yield made
    made.close()


@pytest.fixture
def path(store: AuditStore, tmp_path: Path) -> Path:
    return tmp_path / "arm.sqlite"


def tamper(path: Path, *statements: str) -> None:
    file = sqlite3.connect(path)
    with file:
        for statement in statements:
            file.execute(statement)
    file.close()


def verdict(path: Path, noted: dict[int, bytes] | None = None) -> ChainCheck:
    with reading(path) as (head, links):
        return verify(links, head, noted)


def links(path: Path) -> list[Link]:
    with reading(path) as (_, found):
        return list(found)


def test_a_record_with_an_extra_column_of_a_later_version_is_still_used(store: AuditStore, path: Path) -> None:
    tamper(path, "ALTER TABLE record ADD COLUMN room TEXT")
    store.add([row("rosie.step21")])
    assert (verdict(path).problem, verdict(path).rows) == ("", 21)


def test_rows_follow_each_other_from_the_first(path: Path) -> None:
    found = verdict(path)
    assert (found.problem, found.rows, found.first, found.head.seq) == ("", 20, 1, 20)
    assert links(path)[0].before == NOTHING


@pytest.mark.parametrize(
    ("statements", "at", "says"),
    [
        (["UPDATE record SET who = 'berta' WHERE seq = 7"], 7, "it was changed"),
        (["UPDATE record SET call_id = '7' WHERE seq = 7"], 7, "it was changed"),
        (["DELETE FROM record WHERE seq = 7"], 7, "rows 7 to 7 are missing"),
        (["DELETE FROM record WHERE seq < 7"], 1, "rows 1 to 6 are missing"),
        (["DELETE FROM record WHERE seq > 15"], 16, "rows 16 to 20 are missing, at the end"),
        (["DELETE FROM record"], 1, "rows 1 to 20 are missing, at the end"),
        (
            [
                "UPDATE record SET seq = 100 WHERE seq = 7",
                "UPDATE record SET seq = 7 WHERE seq = 8",
                "UPDATE record SET seq = 8 WHERE seq = 100",
            ],
            7,
            "it was row 8",
        ),
        (
            ["DELETE FROM record WHERE seq = 7", "UPDATE record SET seq = seq - 1 WHERE seq > 7"],
            7,
            "it was row 8",
        ),
        (["UPDATE head SET seq = 15, hash = (SELECT hash FROM record WHERE seq = 15)"], 16, "beyond row 15"),
        (["UPDATE head SET seq = 25"], 21, "rows 21 to 25 are missing, at the end"),
    ],
)
def test_what_was_done_to_a_record_is_found(path: Path, statements: list[str], at: int, says: str) -> None:
    tamper(path, *statements)
    found = verdict(path)
    assert says in found.problem
    assert found.broken_at == at


def test_a_row_put_in_between_is_found_where_those_after_it_were_moved(path: Path) -> None:
    seventh, eighth = links(path)[6:8]
    forged = structs.replace(row("rosie.forged"), seq=8)
    forged_hash = row_hash(seventh.hash, forged)
    tamper(
        path,
        "UPDATE record SET seq = -seq - 1 WHERE seq >= 8",
        "UPDATE record SET seq = -seq WHERE seq < 0",
        "UPDATE head SET seq = 21",
    )
    file = sqlite3.connect(path)
    with file:
        values = (*structs.astuple(forged), seventh.hash, forged_hash)
        file.execute(f"INSERT INTO record VALUES ({', '.join('?' * len(values))})", values)
    file.close()
    assert verdict(path).broken_at == 9
    assert "it was row 8" in verdict(path).problem
    assert eighth.row.seq == 8


def test_a_row_replaced_by_one_that_fits_its_own_hash_is_found_at_the_next(path: Path) -> None:
    sixth = links(path)[5]
    forged = structs.replace(links(path)[6].row, who="berta")
    file = sqlite3.connect(path)
    with file:
        file.execute("UPDATE record SET who = 'berta', hash = ? WHERE seq = 7", (row_hash(sixth.hash, forged),))
    file.close()
    assert verdict(path).broken_at == 8
    assert "does not follow" in verdict(path).problem


def test_only_a_separately_kept_head_reveals_a_completely_rewritten_record(tmp_path: Path, path: Path) -> None:
    noted = {20: verdict(path).head.hash}
    assert verdict(path, noted).problem == ""
    other = tmp_path / "other.sqlite"
    forger = AuditStore(other)
    forger.add([row("rosie.nothing") for _ in range(20)])
    assert verdict(other).problem == ""
    assert verdict(other, noted).broken_at == 20
    assert "noted elsewhere" in verdict(other, noted).problem
    assert verdict(other, {30: bytes(32)}).broken_at == 21
    forger.close()


def test_the_hash_covers_every_field_and_the_row_before() -> None:
    hashes = {row_hash(NOTHING, row("a")), row_hash(bytes([1] * 32), row("a"))}
    for name in AuditRow.__struct_fields__:
        value = getattr(row("a"), name)
        other = value + ("x" if isinstance(value, str) else 1)
        hashes.add(row_hash(NOTHING, structs.replace(row("a"), **{name: other})))
    assert len(hashes) == 2 + len(AuditRow.__struct_fields__)


def test_rows_beyond_the_most_go_by_whole_pieces_and_the_rest_still_verifies(path: Path, store: AuditStore) -> None:
    keep = Retention(days=1, rows=9, least=0, piece=5)
    assert store.drop(keep, row("", at_ns=2)) == 10
    found = verdict(path)
    assert (found.problem, found.first, found.rows) == ("", 11, 11)
    assert store.drop(keep, row("", at_ns=2)) == 0
    assert verdict(path).head == found.head


def test_old_rows_go_and_young_ones_stay(path: Path, store: AuditStore) -> None:
    store.add([row("rosie.young", at_ns=3 * DAY_NS) for _ in range(10)])
    keep = Retention(days=2, rows=1000, least=0, piece=5)
    assert store.drop(keep, row("", at_ns=4 * DAY_NS)) == 20
    found = verdict(path)
    assert (found.problem, found.first) == ("", 21)
    assert store.drop(keep, row("", at_ns=4 * DAY_NS)) == 0


def test_a_clock_far_ahead_does_not_clear_the_record(path: Path, store: AuditStore) -> None:
    assert store.drop(Retention(days=2, rows=1000, least=15, piece=5), row("", at_ns=40_000 * DAY_NS)) == 5
    assert store.drop(Retention(days=2, rows=1000, least=16, piece=5), row("", at_ns=40_000 * DAY_NS)) == 0
    assert verdict(path).problem == ""


def test_rows_deleted_without_a_record_of_it_are_detected(path: Path, store: AuditStore) -> None:
    store.drop(Retention(days=1, rows=9, least=0, piece=5), row("", at_ns=2))
    tamper(path, "DELETE FROM record WHERE seq < 14")
    assert verdict(path).broken_at == 1
    assert "no row says" in verdict(path).problem


def test_the_row_that_records_a_drop_proves_the_last_dropped_row(path: Path, store: AuditStore) -> None:
    hashes = {link.row.seq: link.hash for link in links(path)}
    keep = Retention(days=1, rows=9, least=0, piece=5)
    assert store.drop(keep, row("", at_ns=2)) == 10
    store.add([row("rosie.on") for _ in range(5)])
    assert store.drop(keep, row("", at_ns=2)) == 5
    for seq in (10, 15):  # the last that went the first time, and the second
        right = verdict(path, {seq: hashes[seq]})
        assert (right.problem, right.untold, right.proven) == ("", (), seq)
        wrong = verdict(path, {seq: bytes(32)})
        assert wrong.broken_at == seq
        assert "noted elsewhere" in wrong.problem


def test_a_dropped_row_that_no_other_row_names_is_reported_as_unverifiable(path: Path, store: AuditStore) -> None:
    hashes = {link.row.seq: link.hash for link in links(path)}
    store.drop(Retention(days=1, rows=9, least=0, piece=5), row("", at_ns=2))
    dropped = verdict(path, {7: hashes[7]})
    assert (dropped.problem, dropped.untold, dropped.proven) == ("", (7,), 0)
    both = verdict(path, {7: bytes(32), 12: hashes[12]})
    assert (both.problem, both.untold, both.proven) == ("", (7,), 12)
    assert verdict(path, {7: hashes[7], 12: bytes(32)}).broken_at == 12


def test_two_that_write_to_one_file_keep_one_chain(path: Path, store: AuditStore) -> None:
    other = AuditStore(path)
    for i in range(5):
        assert store.add([row(f"mine{i}")]).seq == 21 + 2 * i
        assert other.add([row(f"theirs{i}")]).seq == 22 + 2 * i
    other.close()
    assert (verdict(path).problem, verdict(path).rows) == ("", 30)


def test_nothing_is_added_if_one_row_cannot_be(path: Path, store: AuditStore) -> None:
    with pytest.raises(OverflowError):
        store.add([row("fits"), structs.replace(row("does not"), call_id=1 << 70)])
    assert (verdict(path).problem, verdict(path).rows) == ("", 20)
    assert store.add([row("continues")]) == Head(21, verdict(path).head.hash)
