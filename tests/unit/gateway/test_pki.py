"""The authority in a folder, and the commands that use it."""

import json
import re
import ssl
import subprocess
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
import typer
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from typer.testing import CliRunner, Result

from trade import atomic_files
from trade.errors import ConfigurationError, TradeError
from trade.policies import read_policy
from trade_gateway.cli import build
from trade_gateway.pki import _authority
from trade_gateway.pki._authority import Authority, Issued, NameRevoked, NameTaken, NoAuthority
from trade_gateway.pki._command import app

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "pki"


@pytest.fixture
def authority(folder: Path) -> Authority:
    return Authority.create(folder)


def certificate(issued: Issued) -> x509.Certificate:
    return x509.load_pem_x509_certificate((issued.folder / "cert.pem").read_bytes())


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_certificate_says_who_it_is_and_serves_both_ends_of_a_link(authority: Authority) -> None:
    made = certificate(authority.issue("arm", hosts=["arm.example"], addresses=["10.0.0.5", "fe80::1"]))
    assert [name.value for name in made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == ["arm"]
    uses = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(uses) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {str(name.value) for name in names} == {
        *("localhost", "127.0.0.1", "::1"),
        *("arm.example", "10.0.0.5", "fe80::1"),
    }
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_a_certificate_lasts_as_long_as_asked_for_but_not_longer_than_its_authority(authority: Authority) -> None:
    before = datetime.now(timezone.utc).replace(microsecond=0)  # certificates know whole seconds
    asked, default = authority.issue("arm", lasts=timedelta(hours=2)), authority.issue("leg")
    assert asked.until is not None and default.until is not None
    assert before + timedelta(hours=2) <= asked.until <= datetime.now(timezone.utc) + timedelta(hours=2)
    assert default.until - asked.until > timedelta(days=6)
    endless = authority.issue("tool", lasts=timedelta(days=36500)).until
    own = x509.load_pem_x509_certificate((authority.folder / "ca.pem").read_bytes())
    assert endless == own.not_valid_after_utc


def test_keys_are_for_their_owner_only(authority: Authority) -> None:
    keys = [authority.folder / "ca.key", authority.issue("arm").folder / "key.pem"]
    assert [key.stat().st_mode & 0o777 for key in keys] == [0o600, 0o600]
    assert authority.issue("arm").folder.stat().st_mode & 0o077 == 0


def test_the_next_certificate_has_the_same_key_and_hosts_and_nothing_is_left_beside_it(authority: Authority) -> None:
    first = authority.issue("arm", addresses=["10.0.0.5"], lasts=timedelta(hours=1))
    before = files(first.folder)
    second = authority.issue("arm", hosts=["arm.example"])
    after = files(second.folder)
    assert first.folder == second.folder and before.keys() == after.keys() == {"ca.pem", "cert.pem", "key.pem"}
    assert before["key.pem"] == after["key.pem"] and before["cert.pem"] != after["cert.pem"]
    assert second.hosts == ("10.0.0.5", "arm.example")
    assert first.until is not None and second.until is not None and first.until < second.until


def test_a_reader_of_a_certificate_gets_a_whole_one_while_it_is_replaced(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = authority.issue("arm").folder / "cert.pem"
    before, seen, claim = path.read_bytes(), [], atomic_files.claim

    def watched(fresh: Path, text: bytes) -> None:
        claim(fresh, text)
        seen.append(path.read_bytes())

    monkeypatch.setattr(atomic_files, "claim", watched)
    authority.issue("arm")
    assert seen and set(seen) == {before}
    assert path.read_bytes() != before


def test_a_certificate_with_another_key_keeps_no_addresses(authority: Authority) -> None:
    first = authority.issue("arm", addresses=["10.0.0.5"])
    key = (first.folder / "key.pem").read_bytes()
    second = authority.issue("arm", new_key=True)
    assert (second.folder / "key.pem").read_bytes() != key
    assert second.hosts == ()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(second.folder / "cert.pem", second.folder / "key.pem")  # raises if they do not fit


@pytest.mark.parametrize("gone", ["key.pem", "cert.pem"])
def test_a_certificate_that_no_longer_exists_is_not_renewed_but_issued_again(authority: Authority, gone: str) -> None:
    folder = authority.issue("arm").folder
    (folder / gone).unlink()
    with pytest.raises(ConfigurationError, match=f"{gone}.*--force"):
        authority.issue("arm")
    assert authority.issue("arm", new_key=True).until is not None


@pytest.mark.parametrize(("first", "second"), [("gateway", "container"), ("container", "gateway")])
def test_the_name_of_a_gateway_is_never_signed_for_another_owner(authority: Authority, first: Any, second: Any) -> None:
    given = authority.issue("door", purpose=first)
    before = files(given.folder)
    for force in (False, True):
        with pytest.raises(NameTaken, match=f"is permanently the name of a {first}"):
            authority.issue("door", purpose=second, new_key=force)
    assert files(given.folder) == before
    assert authority.issue("door").purpose == first  # renewing needs no reminder


def test_what_a_name_was_given_for_outlives_its_files(authority: Authority) -> None:
    folder = authority.issue("door", purpose="gateway").folder
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    with pytest.raises(NameTaken):
        Authority(authority.folder).issue("door", purpose="container", new_key=True)
    [listed] = authority.issued()
    assert (listed.purpose, listed.until) == ("gateway", None)


def test_files_of_other_programs_in_the_folder_are_no_names(authority: Authority) -> None:
    authority.issue("door")
    (authority.folder / "names" / ".DS_Store").write_text("")
    assert [one.name for one in authority.issued()] == ["door"]


def test_a_name_with_a_damaged_purpose_counts_as_a_gateway(authority: Authority) -> None:
    authority.issue("door")
    (authority.folder / "names" / "door").write_text("contai")
    with pytest.raises(NameTaken):
        authority.issue("door", purpose="container")


@pytest.mark.parametrize("force", [False, True])
def test_a_revoked_name_is_not_issued_again(authority: Authority, force: bool) -> None:
    before = files(authority.issue("arm").folder)
    authority.issue("leg")
    assert authority.revoke("arm").revoked
    with pytest.raises(NameRevoked, match="choose another name"):
        authority.issue("arm", new_key=force)
    assert files(authority.folder / "issued" / "arm") == before
    assert not authority.issue("leg").revoked


def test_the_list_of_revoked_names_is_one_that_programs_read(authority: Authority) -> None:
    for name in ("leg", "arm", "tool"):
        authority.issue(name)
    for name in ("leg", "arm", "leg"):
        authority.revoke(name)
    assert authority.revoked() == {"arm", "leg"}
    assert 'revoked = ["arm", "leg"]' in (authority.folder / "revoked.toml").read_text().splitlines()


def test_two_revocations_at_the_same_time_are_both_kept(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("arm", "leg"):
        authority.issue(name)
    replace, others = _authority.replace, iter([lambda: Authority(authority.folder).revoke("leg")])

    def late(path: Path, text: bytes, mode: int) -> None:
        for other in others:  # comes in between, and is done before the first one writes
            other()
        replace(path, text, mode)

    monkeypatch.setattr(_authority, "replace", late)
    authority.revoke("arm")
    assert read_policy(a_policy_with(authority.folder / "revoked.toml")).revoked == {"arm", "leg"}
    assert authority.revoked() == {"arm", "leg"}


def test_a_revoked_name_is_not_issued_again_even_if_the_list_is_lost(authority: Authority) -> None:
    for name in ("arm", "leg"):
        authority.issue(name)
    authority.revoke("arm")
    (authority.folder / "revoked.toml").unlink()
    with pytest.raises(NameRevoked):
        authority.issue("arm")
    authority.revoke("leg")
    assert 'revoked = ["arm", "leg"]' in (authority.folder / "revoked.toml").read_text()


def a_policy_with(revoked_file: Path) -> Path:
    path = revoked_file.with_name("policy.toml")
    path.write_text('revoked_file = "revoked.toml"\n[roles]\n[identities]\n')
    return path


def test_a_new_authority_has_a_list_of_revoked_names_that_a_policy_can_name(authority: Authority) -> None:
    assert read_policy(a_policy_with(authority.folder / "revoked.toml")).revoked == set()


@pytest.mark.parametrize(
    "text", ["revoked = arm", "revoked = 'arm'", "revoked = [1]", "revoked = ['a b']", "", "names = []"]
)
def test_a_damaged_list_forgets_no_revoked_identity(authority: Authority, text: str) -> None:
    authority.issue("arm")
    (authority.folder / "revoked.toml").write_text(text)
    for act in (lambda: authority.issue("arm"), lambda: authority.revoke("arm"), authority.issued):
        with pytest.raises(ConfigurationError, match=r"revoked\.toml: must be like"):
            act()
    assert (authority.folder / "revoked.toml").read_text() == text


def test_revoking_a_name_that_was_never_issued_lists_the_issued_names(authority: Authority) -> None:
    authority.issue("arm")
    with pytest.raises(ConfigurationError, match="amr: was never issued; there is arm"):
        authority.revoke("amr")


@pytest.mark.parametrize("name", ["", ".", "..", ".arm", "a/b", "a b", "*", "$x", "a" * 65, "../arm"])
def test_an_invalid_identity_is_not_issued(authority: Authority, name: str) -> None:
    with pytest.raises(ConfigurationError, match="is no identity"):
        authority.issue(name)
    assert authority.issued() == []


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"addresses": ["arm.example"]}, "--address: .*names go with --host"),
        ({"hosts": ["10.0.0.5"]}, "say --address 10.0.0.5"),
        ({"hosts": ["tls/arm:7450"]}, "is no name of a host"),
        ({"hosts": ["ärm"]}, "is no name of a host"),
        ({"hosts": [""]}, "is no name of a host"),
    ],
)
def test_an_invalid_host_is_refused_and_uses_up_no_name(authority: Authority, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        authority.issue("arm", **wrong)
    assert authority.issued() == []


def test_a_second_authority_in_a_folder_is_refused_and_the_first_one_stays(authority: Authority) -> None:
    before = (authority.folder / "ca.key").read_bytes(), (authority.folder / "ca.pem").read_bytes()
    with pytest.raises(NoAuthority, match="there is an authority already"):
        Authority.create(authority.folder)
    assert before == ((authority.folder / "ca.key").read_bytes(), (authority.folder / "ca.pem").read_bytes())


def test_an_authority_that_cannot_be_used_says_why(authority: Authority, tmp_path: Path) -> None:
    folder = authority.folder
    with pytest.raises(NoAuthority, match="create one with trade pki init"):
        Authority(tmp_path / "nowhere")
    (folder / "ca.key").chmod(0o640)
    with pytest.raises(NoAuthority, match="chmod 600"):
        Authority(folder)
    other = Authority.create(tmp_path / "other").folder / "ca.key"
    (folder / "ca.key").write_bytes(other.read_bytes())
    (folder / "ca.key").chmod(0o600)
    with pytest.raises(NoAuthority, match=r"is not the key of ca\.pem"):
        Authority(folder)
    (folder / "ca.key").write_text("nonsense")
    with pytest.raises(NoAuthority, match="cannot be read"):
        Authority(folder)


def test_an_expired_authority_issues_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_authority, "_AUTHORITY_LASTS", timedelta(0))
    authority = Authority.create(folder)
    with pytest.raises(NoAuthority, match=r"has expired .*create a new one"):
        authority.issue("arm")
    assert authority.issued() == []


def said(*words: object) -> Result:
    return CliRunner().invoke(app, [*map(str, words)])


def refused(*words: object) -> TradeError:
    error = said(*words).exception
    assert isinstance(error, TradeError)
    return error


def test_the_commands_make_an_identity_and_say_how_to_start_with_it(folder: Path) -> None:
    assert "ca.key secret" in said("init", folder).stdout
    issued = said("issue", "arm", "--ca", folder, "--address", "fe80::1", "--address", "10.0.0.5").stdout
    assert str(folder / "issued" / "arm") in issued
    variables = dict(re.findall(r"(TRADE_\w+)=(\S+)", issued))
    assert variables["TRADE_LISTEN"] == "tls/10.0.0.5:7450"
    assert (Path(variables["TRADE_TLS"]) / "key.pem").is_file()
    assert {"TRADE_SYSTEM", "TRADE_POLICY", "TRADE_CONNECT"} <= variables.keys()


def test_a_host_without_address_is_advised_to_dial_and_not_to_listen(folder: Path) -> None:
    said("init", folder)
    issued = said("issue", "planner", "--ca", folder).stdout
    assert "TRADE_LISTEN" not in issued
    assert "export TRADE_CONNECT=tls/" in issued


@pytest.mark.parametrize("purpose", ["container", "gateway"])
def test_the_commands_that_the_output_advises_exist(folder: Path, purpose: str) -> None:
    said("init", folder)
    issued = said("issue", "ada", "--for", purpose, "--address", "10.0.0.5", "--ca", folder).stdout
    advised = re.findall(r"(?:^ *|or )trade ([a-z]+)", issued, re.MULTILINE)
    assert advised and set(advised) <= vars(typer.main.get_command(build()))["commands"].keys()


def test_a_gateway_receives_its_file_with_all_its_addresses(folder: Path) -> None:
    said("init", folder)
    addresses = ["--address", "192.168.7.1", "--address", "10.0.0.7", "--host", "gate.example"]
    issued = said("issue", "gate", "--for", "gateway", *addresses, "--ca", folder).stdout
    assert "trade gateway GATEWAY.toml" in issued and "trade up" not in issued
    assert f'tls = "{folder / "issued" / "gate"}"' in issued
    listens = ("192.168.7.1", "10.0.0.7", "gate.example")
    assert [f'listen = ["tls/{host}:7450"]' in issued for host in listens] == [True] * 3
    assert 'gateways = ["gate"]' in issued


def test_of_the_next_certificate_only_the_files_to_copy_are_listed(folder: Path) -> None:
    said("init", folder)
    said("issue", "arm", "--address", "10.0.0.5", "--ca", folder)
    renewed = said("issue", "arm", "--ca", folder).stdout
    assert str(folder / "issued" / "arm" / "cert.pem") in renewed and "10.0.0.5" in renewed
    assert "TRADE_" not in renewed and "key.pem" not in renewed
    assert "key.pem" in said("issue", "arm", "--force", "--ca", folder).stdout  # another key has to be taken along


def test_the_commands_list_the_issued_names(folder: Path) -> None:
    said("init", folder)
    assert "no identity was issued yet" in said("list", "--ca", folder).stdout
    said("issue", "door", "--for", "gateway", "--ca", folder)
    Authority(folder).issue("old", lasts=timedelta(minutes=-1))
    said("issue", "bad", "--host", "bad.example", "--ca", folder)
    said("revoke", "bad", "--ca", folder)
    listed = {entry["name"]: entry for entry in json.loads(said("list", "--json", "--ca", folder).stdout)}
    assert {name: (entry["for"], entry["state"]) for name, entry in listed.items()} == {
        "bad": ("container", "revoked"),
        "door": ("gateway", "valid"),
        "old": ("container", "expired"),
    }
    assert listed["bad"]["hosts"] == ["bad.example"]
    lines = said("list", "--ca", folder).stdout.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [["bad", "container"], ["door", "gateway"], ["old", "container"]]


def test_the_commands_say_what_is_wrong(folder: Path) -> None:
    assert isinstance(refused("issue", "arm", "--ca", folder), NoAuthority)
    said("init", folder)
    said("issue", "door", "--for", "gateway", "--ca", folder)
    assert isinstance(refused("issue", "door", "--for", "container", "--ca", folder), NameTaken)
    assert "use container or gateway" in str(refused("issue", "x", "--for", "robot", "--ca", folder))
    revoked = said("revoke", "door", "--ca", folder).stdout
    assert str(folder / "revoked.toml") in revoked and "every host" in revoked
    assert isinstance(refused("issue", "door", "--ca", folder), NameRevoked)
    assert said("issue", "x", "--hours", "0", "--ca", folder).exit_code == 2


@pytest.mark.realtime
def test_a_refusal_is_a_line_on_standard_error(folder: Path) -> None:
    import sys

    command = [sys.executable, "-m", "trade_gateway", "pki", "list", "--ca", str(folder)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith("NoAuthority: ") and "trade pki init" in ended.stderr
