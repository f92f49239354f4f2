"""A backup has all that a gateway needs to be the same again, and nothing that it should not put anywhere."""

import contextlib
import hashlib
import io
import os
import shutil
import sqlite3
import stat
import tarfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner, Result

from tests.support.certificates import Papers
from trade.errors import ConfigurationError
from trade.policies import read_policy
from trade_gateway.cli import app
from trade_gateway.cli.operation._archive import Manifest, read_archive, unpack
from trade_gateway.supervisor._single_instance import alone, lock_of

ROOT = Path(__file__).parents[3]
FILE = """
system = "lab"
tls = "pki/issued/door"
policy = "policy.toml"

[network.robot]
interface = "eth0"
listen = ["tls/127.0.0.1:7450"]

[network.lab]
interface = "eth1"
listen = ["tls/0.0.0.0:7451"]
"""
SYSTEM_FILE = """
[system]
name = "lab"

[container.door]
gateway = "gateway.toml"

[container.rosie]
robot = "robots/head.toml"
tls = "pki/issued/rosie"

[container.elsewhere]
host = "anna@far.example"
robot = "/robots/far.toml"

[container.rules]
rules = "rules.toml"

[container.page]
http = { tokens = "pages/tokens.toml", mcp = true, twin = "pages/twin.toml" }
"""
KEYS = {f"config/pki/issued/door/{name}" for name in ("ca.pem", "cert.pem", "key.pem")}


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The folder of a gateway file and all that it names."""
    folder = tmp_path / "etc"
    (folder / "robots").mkdir(parents=True)
    (folder / "gateway.toml").write_text(FILE)
    (folder / "policy.toml").write_text('revoked_file = "revoked.toml"\ngateways = ["door"]\n[roles]\n[identities]\n')
    (folder / "revoked.toml").write_text("revoked = []")
    Papers(folder / "pki").of("door", purpose="gateway")
    return folder


@pytest.fixture
def state(tmp_path: Path) -> Path:
    folder = tmp_path / "var"
    (folder / "lab" / "estop" / "door").mkdir(parents=True)
    (folder / "lab" / "estop" / "door" / "open").write_text("smoke")
    (folder / "lab" / "logs").mkdir()
    (folder / "lab" / "logs" / "door.log").write_text("long")
    (folder / "other").mkdir()
    (folder / "other" / "secret").write_text("of another system")
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "trade.tar.gz"


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)


def back_up(config: Path, out: Path, state: Path, *more: str) -> Manifest:
    assert run("backup", config / "gateway.toml", out, "--state", state, *more).exit_code == 0
    return read_archive(out)


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_it_has_what_the_gateway_file_names_and_the_state_of_its_system(config: Path, state: Path, out: Path) -> None:
    manifest = back_up(config, out, state)
    named = {f"config/{name}" for name in ("gateway.toml", "policy.toml", "revoked.toml")}
    assert {entry.path for entry in manifest.files} == {*named, *KEYS, "state/lab/estop/door/open"}
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    assert not list(out.parent.glob(".trade*"))


def test_however_the_gateway_file_is_named(
    config: Path, state: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = [entry.path for entry in back_up(config, out, state).files]
    monkeypatch.chdir(config / "robots")
    run("backup", "../gateway.toml", out, "--state", state, "--force")
    assert [entry.path for entry in read_archive(out).files] == expected


def test_put_back_everything_is_as_it_was(config: Path, state: Path, out: Path, tmp_path: Path) -> None:
    back_up(config, out, state)
    to = tmp_path / "new" / "etc"
    reported = run("restore", out, "--to", to, "--state", tmp_path / "new" / "var").stdout
    assert f"trade gateway {to}/gateway.toml --check" in " ".join(reported.split())
    assert content(to).items() <= content(config).items()
    assert content(tmp_path / "new" / "var") == {"lab/estop/door/open": b"smoke"}
    for name in KEYS:
        before, after = (folder / name.removeprefix("config/") for folder in (config, to))
        assert before.stat().st_mode == after.stat().st_mode
    assert run("gateway", to / "gateway.toml", "--check").exit_code == 0


def test_of_a_system_file_it_has_the_gateway_robots_and_rules_of_this_host(
    config: Path, state: Path, out: Path
) -> None:
    (config / "system.toml").write_text(SYSTEM_FILE)
    (config / "robots" / "head.toml").write_text((ROOT / "examples" / "head.toml").read_text())
    (config / "rules.toml").write_text("")
    (config / "pages").mkdir()
    (config / "pages" / "tokens.toml").write_text("[tokens]\n")
    (config / "pages" / "twin.toml").write_text((ROOT / "examples" / "head.toml").read_text())
    shutil.copytree(config / "pki" / "issued" / "door", config / "pki" / "issued" / "rosie")
    assert run("backup", config / "system.toml", out, "--state", state).exit_code == 0
    manifest = read_archive(out)
    assert manifest.file == "config/system.toml"
    expected = {
        "config/system.toml",
        "config/gateway.toml",
        "config/pages/tokens.toml",
        "config/pages/twin.toml",
        "config/robots/head.toml",
        "config/rules.toml",
        *KEYS,
    }
    expected |= {name.replace("door", "rosie") for name in KEYS}
    assert expected < {entry.path for entry in manifest.files}
    assert not any("far" in entry.path for entry in manifest.files)


def test_without_any_state_it_says_so(config: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_STATE_DIR", str(tmp_path / "none"))
    reported = run("backup", config / "gateway.toml", out)
    assert f"there is no state in {tmp_path}/none" in reported.stderr.replace("\n", "")


def rows(path: Path) -> list[int]:
    with contextlib.closing(sqlite3.connect(path)) as database:
        return [number for (number,) in database.execute("select number from kept order by number")]


@pytest.fixture
def database(state: Path) -> Path:
    return state / "lab" / "door.state.sqlite"


def writing(path: Path) -> sqlite3.Connection:
    opened = sqlite3.connect(path)
    opened.execute("pragma journal_mode = wal")
    opened.execute("create table if not exists kept (number integer)")
    return opened


def test_a_database_in_use_is_backed_up_as_it_was_committed_last(
    config: Path, state: Path, out: Path, database: Path, tmp_path: Path
) -> None:
    with contextlib.closing(writing(database)) as busy:
        with busy:
            busy.execute("insert into kept values (1)")
        busy.execute("insert into kept values (2)")  # and is not committed
        assert database.with_name("door.state.sqlite-wal").stat().st_size
        manifest = back_up(config, out, state)
    assert [entry.path for entry in manifest.files if entry.database] == ["state/lab/door.state.sqlite"]
    run("restore", out, "--to", tmp_path / "new")
    assert rows(tmp_path / "new" / "state" / "lab" / "door.state.sqlite") == [1]


def test_what_a_database_left_unfinished_does_not_get_into_the_one_put_back(
    config: Path, state: Path, out: Path, database: Path
) -> None:
    with contextlib.closing(writing(database)) as busy, busy:
        busy.execute("insert into kept values (1)")
    back_up(config, out, state)
    killed = writing(database)
    with killed:
        killed.execute("insert into kept values (2)")
    unfinished = database.with_name("door.state.sqlite-wal").read_bytes()
    killed.close()
    database.with_name("door.state.sqlite-wal").write_bytes(unfinished)  # as if that process had been killed
    assert run("restore", out, "--to", config, "--state", state, "--force").exit_code == 0
    assert rows(database) == [1]


def test_a_damaged_database_is_kept_as_it_is_and_said(config: Path, state: Path, out: Path, database: Path) -> None:
    database.write_bytes(b"SQLite format 3\0" + b"garbage" * 500)
    reported = run("backup", config / "gateway.toml", out, "--state", state)
    assert "door.state.sqlite is damaged" in reported.stderr.replace("\n", " ")
    [entry] = [entry for entry in read_archive(out).files if entry.path.endswith("sqlite")]
    assert entry.sha256 == hashlib.sha256(database.read_bytes()).hexdigest()


def test_an_existing_backup_is_not_overwritten(config: Path, state: Path, out: Path) -> None:
    out.write_text("the last one")
    with pytest.raises(ConfigurationError, match="exists already"):
        back_up(config, out, state)
    assert out.read_text() == "the last one"
    assert back_up(config, out, state, "--force").files


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace('"policy.toml"', '"../policy.toml"'), r"policy.toml: is not in .*move it there"),
        (
            lambda text: text.replace('"pki/issued/door"', '"pki/issued/dor"'),
            r"dor/ca.pem: is named, but does not exist",
        ),
        (lambda text: text.replace("system =", "system"), r"gateway.toml: not valid TOML"),
        (lambda text: text.replace('"lab"', "3"), r"gateway.toml: cannot be read: .*system"),
    ],
)
def test_a_file_that_could_not_be_restored_is_not_backed_up(
    config: Path, state: Path, out: Path, change: Callable[[str], str], said: str
) -> None:
    file = config / "gateway.toml"
    file.write_text(change(FILE))
    (config.parent / "policy.toml").write_text("")
    with pytest.raises(ConfigurationError, match=said):
        back_up(config, out, state)
    assert not out.exists()
    assert not list(out.parent.glob(".trade*"))


def test_a_backup_is_not_written_into_a_folder_that_it_backs_up(config: Path, state: Path) -> None:
    with pytest.raises(ConfigurationError, match="is in the folder for state"):
        back_up(config, state / "lab" / "trade.tar.gz", state)


def test_nothing_is_overwritten_unless_by_force(config: Path, state: Path, out: Path, tmp_path: Path) -> None:
    back_up(config, out, state)
    to = tmp_path / "new"
    to.mkdir()
    (to / "policy.toml").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"new/policy.toml: would be overwritten.*Nothing was written"):
        run("restore", out, "--to", to)
    assert content(to) == {"policy.toml": b"mine"}
    run("restore", out, "--to", to, "--force")
    assert (to / "policy.toml").read_bytes() == (config / "policy.toml").read_bytes()


def test_an_identity_revoked_after_the_backup_stays_revoked(
    config: Path, state: Path, out: Path, tmp_path: Path
) -> None:
    (config / "revoked.toml").write_text('revoked = ["old"]')
    back_up(config, out, state)
    (config / "revoked.toml").write_text('revoked = ["new"]')
    reported = run("restore", out, "--to", config, "--state", tmp_path / "var-again", "--force")
    assert read_policy(config / "policy.toml").revoked == {"old", "new"}
    assert "new stays revoked" in reported.stderr


def test_nothing_is_restored_while_a_container_runs(config: Path, state: Path, out: Path) -> None:
    back_up(config, out, state)
    before = content(state)
    with alone(lock_of(state / "lab", "door", "rosie")), pytest.raises(ConfigurationError, match="stop its gateway"):
        run("restore", out, "--to", config, "--state", state, "--force")
    assert before.items() <= content(state).items()
    run("restore", out, "--to", config, "--state", state, "--force")  # it has ended


def test_a_link_does_not_lead_it_out_of_its_folder(config: Path, state: Path, out: Path, tmp_path: Path) -> None:
    back_up(config, out, state)
    to, elsewhere = tmp_path / "new", tmp_path / "elsewhere"
    to.mkdir()
    elsewhere.mkdir()
    (to / "pki").symlink_to(elsewhere)
    with pytest.raises(ConfigurationError, match="is a link that leads out"):
        run("restore", out, "--to", to, "--force")
    assert not list(elsewhere.iterdir())
    (to / "pki").unlink()
    (elsewhere / "policy.toml").write_text("theirs")
    (to / "policy.toml").symlink_to(elsewhere / "policy.toml")
    run("restore", out, "--to", to, "--force")
    assert (elsewhere / "policy.toml").read_text() == "theirs"
    assert not (to / "policy.toml").is_symlink()


Members = list[tuple[tarfile.TarInfo, bytes]]


def read(out: Path) -> Members:
    with tarfile.open(out) as archive:
        return [(member, (archive.extractfile(member) or io.BytesIO()).read()) for member in archive]


def write(out: Path, members: Members) -> None:
    with tarfile.open(out, "w:gz") as archive:
        for member, data in members:
            member.size = len(data) if member.isreg() else 0
            archive.addfile(member, io.BytesIO(data))


def spoken(members: Members, before: str, after: str) -> Members:
    """With another manifest."""
    return [(members[0][0], members[0][1].replace(before.encode(), after.encode())), *members[1:]]


def renamed(members: Members, name: str) -> Members:
    """With another name of the last file, in the manifest as well."""
    last = members[-1][0].name
    members[-1][0].name = name
    return spoken(members, f'"{last}"', f'"{name}"')


def linked(members: Members) -> Members:
    """With a link in place of the last file."""
    members[-1][0].type, members[-1][0].linkname = tarfile.SYMTYPE, "/etc/passwd"
    return members


def said_empty(members: Members) -> Members:
    manifest = msgspec.json.decode(members[0][1], type=Manifest)
    return [(members[0][0], msgspec.json.encode(msgspec.structs.replace(manifest, files=[]))), *members[1:]]


CHANGES: dict[str, Callable[[Members], Members]] = {
    "another content": lambda members: [*members[:-1], (members[-1][0], members[-1][1][::-1])],
    "a longer one": lambda members: [*members[:-1], (members[-1][0], members[-1][1] + b"!")],
    "a file less": lambda members: members[:-1],
    "a file twice": lambda members: [*members, members[-1]],
    "a file more": lambda members: [*members, (tarfile.TarInfo("config/more"), b"")],
    "no manifest": lambda members: members[1:],
    "a manifest of nothing": said_empty,
    "a manifest of tomorrow": lambda members: spoken(members, '"format": 1', '"format": 2'),
    "no JSON": lambda members: spoken(members, "{", "["),
    "a link": linked,
    "a way up": lambda members: renamed(members, "config/../../evil"),
    "a way from the root": lambda members: renamed(members, "/evil"),
    "another part": lambda members: renamed(members, "evil/evil"),
    "no part": lambda members: renamed(members, "evil"),
    "a detour": lambda members: renamed(members, "config/./evil"),
    "a bit for others' rights": lambda members: spoken(members, '"mode": 3', '"mode": 204'),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_changed_is_refused_before_anything_is_written(
    config: Path, state: Path, out: Path, tmp_path: Path, change: str
) -> None:
    back_up(config, out, state)
    write(out, read(out))
    assert run("backup", "--check", out).exit_code == 0  # written again as it was, it is whole
    write(out, CHANGES[change](read(out)))
    for words in (["restore", out, "--to", tmp_path / "new"], ["backup", "--check", out]):
        with pytest.raises(ConfigurationError, match="is no backup, or a damaged one"):
            run(*words)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("change", ["another content", "a file less", "a manifest of nothing"])
def test_what_is_changed_after_it_was_looked_through_is_not_put_in_place(
    config: Path, state: Path, out: Path, tmp_path: Path, change: str
) -> None:
    manifest = back_up(config, out, state)
    write(out, CHANGES[change](read(out)))
    with pytest.raises(ConfigurationError, match="is no backup, or a damaged one"):
        unpack(out, manifest, {"config": tmp_path / "new", "state": tmp_path / "new" / "state"})
    assert not (tmp_path / "new" / "state" / "lab" / "estop" / "door" / "open").exists()
    assert not list((tmp_path / "new").rglob(".*"))


@pytest.mark.parametrize("damage", ["cut short", "one bit", "no archive"])
def test_what_was_damaged_is_refused(config: Path, state: Path, out: Path, damage: str) -> None:
    back_up(config, out, state)
    data = bytearray(out.read_bytes())
    if damage == "one bit":
        data[len(data) // 2] ^= 1
    out.write_bytes({"cut short": data[:-100], "one bit": data, "no archive": b"hello"}[damage])
    with pytest.raises(ConfigurationError, match="is no backup, or a damaged one"):
        run("backup", "--check", out)


def test_a_disk_that_refuses_leaves_what_was_there_and_no_pieces(
    config: Path, state: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(config, out, state)
    to = tmp_path / "new"
    to.mkdir()
    (to / "gateway.toml").write_text("mine")

    def full(_file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigurationError, match="No space left on device"):
        run("restore", out, "--to", to, "--force")
    assert content(to) == {"gateway.toml": b"mine"}
