"""Certificates prove who a container is; who has none is not linked; what is wrong with one is said at once."""

import contextlib
import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until, wait_until_dialled
from trade import Container, Settings, service, where
from trade._container import certificate_end
from trade._security.certificates import Certificate
from trade._threads.scheduler import Scheduler
from trade.errors import AccessDenied, CannotConnect, ConfigurationError, ContainerLost, NoSuchService
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport, configuration

pytestmark = pytest.mark.realtime


class Echo:
    @service(effect="read")
    def echo(self, value: int) -> int:
        return value


@pytest.fixture
def papers(tmp_path: Path) -> Papers:
    return Papers(tmp_path / "pki")


@pytest.fixture
def strangers(tmp_path: Path) -> Papers:
    """Those of another authority."""
    return Papers(tmp_path / "elsewhere")


def links(container: Container) -> list[tuple[str, str]]:
    """Where its links lead, and which containers it sees."""
    assert isinstance(container._parts.transport, ZenohTransport)
    found = container._parts.transport._session.info.links()
    return sorted((str(link.dst).partition("/")[0], str(link.auth_identifier)) for link in found)


def tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


def echo(container: Container) -> Any:
    return container.find(where(name="echo", local=False), wait_s=20)


def sees_no_other(container: Container) -> bool:
    with pytest.raises(NoSuchService):
        container.find(where(name="echo", local=False), wait_s=1.2)
    return len(container.containers()) == 1 and links(container) == []


def test_containers_with_certificates_find_each_other_and_prove_who_they_are(
    start_container: Any, papers: Papers
) -> None:
    arm, planner = (start_container(f"c-{name}", tls=papers.of(name)) for name in ("arm", "planner"))
    arm.register(Echo(), "robot")
    assert echo(planner)(3) == 3
    assert (arm.address.identity, planner.address.identity) == ("arm", "planner")
    assert (links(arm), links(planner)) == ([("tls", "planner")], [("tls", "arm")])


def test_containers_that_hear_of_each_other_link_to_each_other(start_container: Any, papers: Papers) -> None:
    """The one in the middle is the only one that the others know."""
    middle = tls_endpoint()
    start_container("c0", tls=papers.of("middle"), listen=[middle])
    one, other = (start_container(f"c-{name}", tls=papers.of(name), connect=[middle]) for name in ("one", "other"))
    one.register(Echo(), "robot")
    assert echo(other)(3) == 3
    wait_until(lambda: links(other) == [("tls", "middle"), ("tls", "one")], "the two are linked")


@pytest.mark.parametrize("by", ["127.0.0.1", "localhost"])
def test_a_container_connects_by_certificate_while_it_runs(start_container: Any, papers: Papers, by: str) -> None:
    endpoint = tls_endpoint()
    arm = start_container("arm", tls=papers.of("arm"), listen=[endpoint], connect=[tls_endpoint()])
    arm.register(Echo(), "robot")
    planner = start_container("planner", tls=papers.of("planner"), connect=[tls_endpoint()])
    planner.system.connect(endpoint.replace("127.0.0.1", by))
    assert echo(planner)(3) == 3
    assert links(planner) == [("tls", "arm")]


def test_containers_with_certificates_discover_each_other(start_container: Any, papers: Papers) -> None:
    nowhere = [tls_endpoint()]
    one, other = (start_container(f"c-{name}", tls=papers.of(name), connect=nowhere) for name in ("one", "other"))
    one.register(Echo(), "robot")
    one.system.set_broadcast(True)
    other.system.set_discovery(True)
    assert echo(other)(3) == 3
    wait_until(lambda: ("tls", "one") in links(other), "the two are linked")


@pytest.mark.parametrize("first", [0, 1], ids=["dialling", "dialled"])
def test_a_container_with_a_certificate_of_another_authority_is_not_linked_and_sees_nothing(
    start_container: Any, papers: Papers, strangers: Papers, first: int
) -> None:
    folders = [papers.of("arm"), strangers.of("arm")]
    containers = [start_container(f"c{number}", tls=folders[number]) for number in (first, 1 - first)]
    for container in containers:
        container.register(Echo(), "robot")
    assert all(sees_no_other(container) for container in containers)


def test_an_endpoint_that_refuses_a_certificate_is_warned_of(
    start_container: Any, papers: Papers, strangers: Papers, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = tls_endpoint()
    start_container("there", tls=papers.of("arm"), listen=[endpoint])
    with caplog.at_level(logging.WARNING, "trade"):
        outsider = start_container("outsider", tls=strangers.of("arm"), connect=[endpoint])
        wait_until_dialled(outsider)
    assert f"no link to {endpoint}: no link was made in time (tried " in caplog.text
    assert "a link takes certificates in date of one authority" in caplog.text
    with pytest.raises(CannotConnect, match="of one authority"):
        outsider.system.connect(endpoint)


def test_an_endpoint_that_takes_a_certificate_is_not_warned_of(
    start_container: Any, papers: Papers, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = tls_endpoint().replace("127.0.0.1", "localhost")
    start_container("there", tls=papers.of("arm"), listen=[endpoint])
    with caplog.at_level(logging.WARNING, "trade"):
        visitor = start_container("visitor", tls=papers.of("planner"), connect=[endpoint])
        wait_until_dialled(visitor)
    assert caplog.text == ""


def test_containers_of_other_systems_are_invisible_whatever_their_certificates(
    start_container: Any, papers: Papers
) -> None:
    endpoint = tls_endpoint()
    arm = start_container("arm", tls=papers.of("arm"), listen=[endpoint])
    arm.register(Echo(), "robot")
    foreign = start_container("foreign", tls=papers.of("planner"), system="another", connect=[endpoint])
    wait_until(lambda: links(foreign), "it is linked, so it could see something")
    with pytest.raises(NoSuchService):
        foreign.find(where(name="echo"), wait_s=1.2)
    assert [info.name for info in foreign.containers()] == ["foreign"]


def impostor(papers: Papers, strangers: Papers, tmp_path: Path, key_of: str) -> Path:
    """Calls itself arm and trusts the right authority."""
    folder = shutil.copytree(strangers.of("arm"), tmp_path / "impostor")
    shutil.copy(papers.of("arm") / "ca.pem", folder)
    if key_of == "stranger":  # the certificate of the real arm is no secret
        shutil.copy(papers.of("arm") / "cert.pem", folder)
    return folder


@pytest.mark.parametrize(
    ("key_of", "said"),
    [
        ("another", r"cert\.pem: was not issued by the authority in ca\.pem beside it"),
        ("stranger", r"key\.pem: is not the key of cert\.pem beside it"),
    ],
)
def test_the_right_name_with_a_wrong_key_is_refused_before_anything_opens(
    system: str, papers: Papers, strangers: Papers, tmp_path: Path, key_of: str, said: str
) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Settings.read(tls=impostor(papers, strangers, tmp_path, key_of))


OpenBare = Callable[..., ZenohTransport]


@pytest.fixture
def open_bare(system: str, papers: Papers) -> Iterator[OpenBare]:
    """Opens transports with certificates that no container would start with."""
    until = Certificate.read(papers.of("anybody")).until
    with contextlib.ExitStack() as stack:

        def start(folder: Path, **endpoints: list[str]) -> ZenohTransport:
            certificate = Certificate(folder, "arm", frozenset(), until)
            settings = {"listen": [tls_endpoint()], "connect": [], **endpoints}
            transport = ZenohTransport(configuration(namespace=system, certificate=certificate, **settings))
            stack.callback(transport.close)
            return transport

        yield start


def is_linked(container: Container, name: str, expected: bool) -> None:
    """Wait for the link, or for as long as one that is refused is tried."""
    if expected:
        wait_until(lambda: ("tls", name) in links(container), "they are linked")
    else:
        wait_until_dialled(container)
        assert links(container) == []


@pytest.mark.parametrize("honest", [True, False], ids=["the right key", "a wrong key"])
def test_the_right_name_with_a_wrong_key_is_not_linked_if_it_opens_all_the_same(
    start_container: Any, open_bare: OpenBare, papers: Papers, strangers: Papers, tmp_path: Path, honest: bool
) -> None:
    endpoint, other = tls_endpoint(), tls_endpoint()
    planner = start_container("planner", tls=papers.of("planner"), listen=[endpoint], connect=[other])
    folder = papers.of("arm") if honest else impostor(papers, strangers, tmp_path, "another")
    open_bare(folder, listen=[other], connect=[endpoint])  # each dials the other
    is_linked(planner, "arm", honest)


@pytest.mark.parametrize("honest", [True, False], ids=["for the host", "for another host"])
def test_a_container_at_an_address_outside_its_certificate_is_not_linked(
    start_container: Any, open_bare: OpenBare, papers: Papers, monkeypatch: pytest.MonkeyPatch, honest: bool
) -> None:
    """Else any container of the system could take another one's address."""
    own, endpoint = papers.of("planner"), tls_endpoint()
    if not honest:
        monkeypatch.setattr("trade_gateway.pki._authority._HERE", ("arm.example", "10.9.9.9"))
    open_bare(papers.of("arm"), listen=[endpoint])
    planner = start_container("planner", tls=own, connect=[endpoint])
    is_linked(planner, "arm", honest)


def test_a_link_ends_when_a_certificate_expires_and_comes_back_when_it_is_renewed(
    start_container: Any, papers: Papers, gate: Any
) -> None:
    planner = start_container("planner", tls=papers.of("planner"))
    tool = start_container("tool", tls=papers.of("tool"))
    arm = start_container("arm", tls=papers.of("arm", lasts=timedelta(seconds=8)))
    arm.register(Echo(), "robot")
    arm.register(gate, "robot")
    run = planner.find(where(name="pass_through"), wait_s=20).start()
    assert gate.entered.wait(30)
    assert echo(planner)(3) == 3
    with pytest.raises(ContainerLost):
        run.result(60)
    wait_until(lambda: not planner.services(where(name="echo")), "what it offered is gone")
    assert links(planner) == [("tls", "tool")]
    assert links(tool) == [("tls", "planner")]
    papers.of("arm")  # it dials the others, as it came last: with the current files
    assert echo(planner)(4) == 4


def test_a_container_warns_at_start_of_a_certificate_that_ends_soon(
    start_container: Any, papers: Papers, caplog: pytest.LogCaptureFixture
) -> None:
    for hours, reported in ((20, True), (30, False)):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "trade"):
            start_container(f"arm-{hours}", tls=papers.of("arm", lasts=timedelta(hours=hours)))
        assert ("the certificate of arm ends" in caplog.text) == reported


def test_a_running_container_is_warned_in_time_before_its_certificate_ends(
    start_container: Any, papers: Papers, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it listens with the one it was started with, a renewed one in its folder does not help."""
    monkeypatch.setattr(certificate_end, "_WARN_AHEAD", (timedelta(hours=22), timedelta(hours=21)))
    with caplog.at_level(logging.WARNING, "trade"):
        for name, hours in (("arm", 22), ("leg", 23)):
            start_container(name, tls=papers.of(name, lasts=timedelta(hours=hours, seconds=2)))
        papers.of("arm")
        wait_until(lambda: said_of_the_end(caplog, "arm") == 1, "it is logged")
    assert said_of_the_end(caplog, "leg") == 0
    assert "start this container again before" in caplog.text


def test_the_end_of_a_certificate_is_reported_twice(
    papers: Papers, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(certificate_end, "_WARN_AHEAD", (timedelta(hours=22), timedelta(hours=21)))
    until = datetime.now(timezone.utc) + timedelta(hours=21, seconds=1)
    with caplog.at_level(logging.WARNING, "trade"):
        timers = Scheduler("trade-timers")
        certificate_end.ExpiryWatch(Certificate(papers.of("arm"), "arm", frozenset(), until), timers)
        assert said_of_the_end(caplog, "arm") == 1
        wait_until(lambda: said_of_the_end(caplog, "arm") == 2, "once more")
        timers.close()


def said_of_the_end(caplog: pytest.LogCaptureFixture, name: str) -> int:
    return caplog.text.count(f"the certificate of {name} ends")


def test_a_folder_that_this_user_may_not_enter_is_named_with_its_owner(
    papers: Papers, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = papers.of("arm")

    def denied(_self: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", denied)
    monkeypatch.setattr(os, "access", lambda path, _mode: Path(path) != folder)
    with pytest.raises(ConfigurationError) as refused:
        Certificate.read(folder)
    assert f"{folder} is of {folder.owner()}:{folder.group()}, with mode 0700; give it to a group" in str(refused.value)
    assert f"chmod 0750 {folder}" in str(refused.value)
    assert "trade pki issue" not in str(refused.value)


def test_with_and_without_certificates_are_not_linked_and_it_says_so(
    start_container: Any, papers: Papers, caplog: pytest.LogCaptureFixture
) -> None:
    start_container("plain").register(Echo(), "robot")
    with caplog.at_level(logging.WARNING, "trade"):
        certified = start_container("certified", tls=papers.of("arm"))
    assert "without certificates, and this container is with certificates: they cannot be linked" in caplog.text
    assert sees_no_other(certified)


@pytest.mark.parametrize(("of", "seen"), [("papers", True), ("strangers", False), ("", False)])
def test_the_command_line_lists_nothing_without_a_certificate_of_the_authority(
    start_container: Any, request: pytest.FixtureRequest, papers: Papers, of: str, seen: bool
) -> None:
    start_container("there", tls=papers.of("arm"))
    visitor = {"TRADE_TLS": str(request.getfixturevalue(of).of("desk"))} if of else {}
    command = [sys.executable, "-m", "trade_gateway", "containers", "--json"]
    environment = {**os.environ, **visitor}
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=environment)
    assert [entry["identity"] for entry in json.loads(ended.stdout)] == (["arm"] if seen else [])


def read(**settings: Any) -> Settings:
    return Settings.read(environment={}, **settings)


def test_the_identity_is_the_certificates(papers: Papers) -> None:
    folder = papers.of("arm")
    assert read(tls=folder).identity == read(tls=folder, identity="arm").identity == "arm"
    assert Settings.read(environment={"TRADE_TLS": str(folder)}).identity == "arm"
    for contradicting in ({"identity": "leg"}, {"environment": {"TRADE_IDENTITY": "leg"}}):
        with pytest.raises(ConfigurationError, match=r"identity: 'leg' contradicts .*cert\.pem, which is of 'arm'"):
            Settings.read(**{"environment": {}, "tls": folder, **contradicting})


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        (folder / name).write_text(text)

    return damage


def encrypt(folder: Path) -> None:
    key = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), None)
    secret = serialization.BestAvailableEncryption(b"secret")
    pkcs8 = serialization.PrivateFormat.PKCS8
    (folder / "key.pem").write_bytes(key.private_bytes(serialization.Encoding.PEM, pkcs8, secret))


def show(folder: Path) -> None:
    (folder / "key.pem").chmod(0o644)


def cut(folder: Path) -> None:
    path = folder / "cert.pem"
    path.write_text(path.read_text().replace("\nM", "\n!", 1))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        *((remove(name), rf"{name}: cannot be read .*trade pki issue") for name in ("ca.pem", "cert.pem", "key.pem")),
        (write("ca.pem", ""), r"ca\.pem: is no certificate in PEM form; trade pki issue"),
        (write("cert.pem", "hello"), r"cert\.pem: is no certificate in PEM form; trade pki issue"),
        (write("key.pem", "hello"), r"key\.pem: is no unencrypted private key in PEM form"),
        (encrypt, r"key\.pem: is no unencrypted private key in PEM form"),
        (show, r"key\.pem: others can read it: chmod 600"),
        (cut, r"one of ca\.pem, cert\.pem, key\.pem is damaged .*trade pki issue"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(papers: Papers, damage: Callable[[Path], None], said: str) -> None:
    folder = papers.of("arm")
    assert read(tls=folder).tls == folder
    damage(folder)
    with pytest.raises(ConfigurationError, match=said):
        read(tls=folder)


def test_a_folder_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere/ca\.pem: cannot be read .*trade pki issue"):
        read(tls=tmp_path / "nowhere")


def test_an_expired_certificate_is_refused_before_anything_opens(papers: Papers) -> None:
    with pytest.raises(ConfigurationError, match=r"cert\.pem: has expired, .*renew it: trade pki issue"):
        read(tls=papers.expired("arm"))
    assert read(tls=papers.of("arm")).identity == "arm"


SERVER, CLIENT, CODE = (getattr(ExtendedKeyUsageOID, name) for name in ("SERVER_AUTH", "CLIENT_AUTH", "CODE_SIGNING"))


@pytest.mark.parametrize(
    ("made_with", "said"),
    [
        ({"_CLOCKS_DIFFER": -timedelta(hours=1)}, r"cert\.pem: is not valid yet\. Is the clock of this host right"),
        (
            {"ExtendedKeyUsageOID": SimpleNamespace(SERVER_AUTH=SERVER, CLIENT_AUTH=CODE)},
            r"cert\.pem: may not be used for both ends of a link",
        ),
        (
            {"ExtendedKeyUsageOID": SimpleNamespace(SERVER_AUTH=CODE, CLIENT_AUTH=CLIENT)},
            r"cert\.pem: may not be used for both ends of a link",
        ),
        ({"_named": lambda _: x509.Name([])}, r"cert\.pem: has the common name \(none\), which is no identity"),
        ({"_HERE": ("arm.example", "10.9.9.9")}, r"is for 10\.9\.9\.9, arm\.example, not for 127\.0\.0\.1"),
    ],
)
def test_certificates_that_are_of_no_use_are_refused(
    papers: Papers, monkeypatch: pytest.MonkeyPatch, made_with: dict[str, Any], said: str
) -> None:
    for name, value in made_with.items():
        monkeypatch.setattr(f"trade_gateway.pki._authority.{name}", value)
    with pytest.raises(ConfigurationError, match=said):
        read(tls=papers.of("arm"))


def test_what_happened_to_the_folder_since_the_settings_were_read_is_said(system: str, papers: Papers) -> None:
    settings = Settings.read(tls=papers.of("arm"))
    papers.expired("arm")
    with pytest.raises(ConfigurationError, match="has expired"):
        Container(settings)
    shutil.copytree(papers.of("leg"), papers.of("arm"), dirs_exist_ok=True)
    with pytest.raises(ConfigurationError, match=r"'arm' contradicts .* which is of 'leg'"):
        Container(settings)


def test_certificates_take_the_place_of_credentials(papers: Papers) -> None:
    with pytest.raises(ConfigurationError, match="credentials: certificates replace them"):
        read(tls=papers.of("arm"), credentials=("me", "secret"))


def test_endpoints_and_certificates_go_together(papers: Papers) -> None:
    folder = papers.of("arm")
    for end in ("listen", "connect"):
        with pytest.raises(ConfigurationError, match=f"{end} tls/127.0.0.1:7450: requires certificates.* TRADE_TLS"):
            read(**{end: ["tls/127.0.0.1:7450"]})
        with pytest.raises(ConfigurationError, match=f"{end} tcp/127.0.0.1:7450: .*must be tls/127.0.0.1:7450"):
            read(tls=folder, **{end: ["tcp/127.0.0.1:7450"]})
        with pytest.raises(ConfigurationError, match="allows nothing after the port"):
            read(tls=folder, **{end: ["tls/127.0.0.1:7450#verify_name_on_connect=false"]})
        for six in ("[::1]", "[::]", "[fe80::1]"):  # the transport would never link, and never say so
            with pytest.raises(ConfigurationError, match="use an IPv4 address or a name"):
                read(tls=folder, system="lab", **{end: [f"tls/{six}:7450"]})


def test_a_tls_container_rejects_endpoints_that_bypass_its_certificate(start_container: Any, papers: Papers) -> None:
    """Its switches are services: anybody who may call them names the endpoint."""
    arm = start_container("arm", tls=papers.of("arm"))
    for endpoint in ("tcp/127.0.0.1:1", "tls/127.0.0.1:1#verify_name_on_connect=false", "tls/127.0.0.1:1?rel=1"):
        with pytest.raises(ConfigurationError):
            arm.system.connect(endpoint)


def test_S21_with_certificates_and_a_policy_a_network_may_be_listened_on_and_reached(papers: Papers) -> None:
    folder, policy = papers.of("arm", addresses=["10.0.0.5"], hosts=["arm.example"]), Path("policy.toml")
    for listen in ("tls/10.0.0.5:7450", "tls/arm.example:7450", "tls/0.0.0.0:7450"):
        chosen: dict[str, Any] = {"tls": folder, "system": "lab", "listen": [listen]}
        settings = read(**chosen, connect=["tls/10.0.0.9:7450"], policy=policy)
        assert settings.listen == (listen,)
        with pytest.raises(ConfigurationError, match="needs a policy, and none is loaded; set TRADE_POLICY"):
            read(**chosen)
        assert read(**chosen, insecure_lan=True).policy is None
    for end in ("listen", "connect"):
        with pytest.raises(
            ConfigurationError, match="reaching a network needs an explicit system id: set TRADE_SYSTEM"
        ):
            read(tls=folder, **{end: ["tls/10.0.0.5:7450"]})


@pytest.mark.parametrize("listen", ["tls/10.0.0.6:7450", "tls/leg.example:7450"])
def test_a_container_does_not_listen_where_its_certificate_is_not_for(papers: Papers, listen: str) -> None:
    """All that dial it there would refuse it, and none would know why."""
    folder = papers.of("arm", addresses=["10.0.0.5"], hosts=["arm.example"])
    with pytest.raises(ConfigurationError, match=r"not for .*trade pki issue arm --address"):
        read(tls=folder, system="lab", listen=[listen], policy=Path("policy.toml"))
    added = papers.of("arm", addresses=["10.0.0.6"], hosts=["LEG.example"])
    assert read(tls=added, system="lab", listen=[listen], policy=Path("policy.toml")).listen == (listen,)


RULES = policy_text("arm=driver planner=viewer", driver="register=robot", viewer="read=robot")


def test_with_a_policy_a_container_gets_nothing_from_identities_outside_it(
    start_container: Any, papers: Papers, tmp_path: Path
) -> None:
    """Directly linked, and whatever the other one's own policy says."""
    policy, lenient = tmp_path / "policy.toml", tmp_path / "lenient.toml"
    policy.write_text(RULES)
    lenient.write_text(RULES.replace("[identities]", '[identities]\nmallory = ["viewer"]'))
    arm = start_container("c-arm", tls=papers.of("arm"), policy=policy)
    arm.register(Echo(), "robot")
    planner = start_container("c-planner", tls=papers.of("planner"), policy=policy)
    mallory = start_container("c-mallory", tls=papers.of("mallory"), policy=lenient)
    assert echo(planner)(3) == 3
    assert ("tls", "mallory") in links(arm)
    with pytest.raises(NoSuchService):
        mallory.find(where(name="echo", local=False), wait_s=1.2)
    stand_in = Echo()
    with pytest.raises(AccessDenied, match="register"):
        mallory.register(stand_in, "robot")


def test_an_identity_that_the_policy_names_only_by_a_pattern_is_warned_of(
    start_container: Any, papers: Papers, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(RULES + '"dash-*" = ["viewer"]\n')
    start_container("c-arm", tls=papers.of("arm"), policy=policy)
    assert "dash-*: the transport needs full names" in caplog.text
