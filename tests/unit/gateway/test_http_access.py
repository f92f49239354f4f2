"""How one gets to the HTTP gateway: under which name, by which page, by what proof; and what is shown of it."""

import logging
import socket
import ssl
import stat
import struct
from collections.abc import Iterator
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.certificates import Papers
from tests.support.http_clients import POLICY, Client, Opened, ask, govern, governed, heard, opened, say
from tests.support.strangers import is_closed
from tests.support.two_joint_robot import Robot
from tests.support.waiting import PATIENCE_S, wait_until
from trade.errors import ConfigurationError
from trade.testing import memory_system
from trade_gateway.http import HttpGateway, Tokens, add_token

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    with governed(tmp_path) as made:
        yield made


def test_strangers_take_a_bounded_number_of_descriptors(served: Opened) -> None:
    place, strangers = urlsplit(served.gateway.url), list[socket.socket]()
    try:
        for _ in range(700):
            strangers.append(socket.create_connection((place.hostname, place.port), timeout=20))
        wait_until(lambda: is_closed(strangers[-1]), "further ones are closed")
        assert not is_closed(strangers[0])  # it has its time to ask for something
    finally:
        for one in strangers:
            one.close()
    wait_until(lambda: _lets_in(served), "it answers again")


def _lets_in(served: Opened) -> bool:
    with suppress(OSError, HTTPException):
        return served.client().ask("GET", "/me").status == 200
    return False


def test_requests_to_another_host_name_are_refused(served: Opened) -> None:
    anna = served.client("anna")
    for wrong in ("evil.example", "evil.example:80", "", "127.0.0.1.evil.example"):
        answer = anna.ask("GET", "/services", Host=wrong)
        assert answer.status in (400, 403), wrong
    for right in ("localhost", "LOCALHOST:1", "127.0.0.1:7080", "[::1]:7080"):
        assert anna.ask("GET", "/services", Host=right).status == 200, right


def test_pages_of_other_sites_are_not_let_in(served: Opened) -> None:
    anna = served.client("anna")
    other_port = f"{served.gateway.url[:-1]}{(int(served.gateway.url[-1]) + 1) % 10}"
    for origin in ("http://evil.example", "null", other_port, served.gateway.url.replace("http", "https")):
        refused = anna.ask("POST", "/estop", {}, Origin=origin)
        assert (refused.status, refused.title) == (403, "WrongOrigin")
        assert "access-control-allow-origin" not in refused.headers
    assert anna.ask("GET", "/estops").body == []


def test_the_gateways_own_page_is_accepted_under_the_host_name_of_its_request(served: Opened) -> None:
    anna, port = served.client("anna"), served.gateway.url.rpartition(":")[2]
    assert anna.ask("GET", "/services", Origin=served.gateway.url).status == 200
    assert anna.ask("GET", "/services", Origin=f"http://localhost:{port}").status == 403
    assert anna.ask("GET", "/services", Origin=f"http://localhost:{port}", Host=f"localhost:{port}").status == 200
    with anna.socket(origin=served.gateway.url) as page:
        assert ask(page, do="call", id=1, group="robot.a", name="move", args=[1.0])["result"] == 1.0
    evil = f"http://evil.example:{port}"
    assert anna.ask("GET", "/services", Origin=evil, Host=f"evil.example:{port}").title == "WrongOrigin"


def test_a_site_that_is_named_is_let_in_and_no_other(tmp_path: Path) -> None:
    page = "http://localhost:5173"
    with memory_system() as system:
        robot = Robot(system)
        with opened(robot.me, tmp_path, origins=[page]) as (made, tokens):
            anna = Opened(robot, made, tokens).client()
            asked = {"Access_Control_Request_Method": "POST", "Access_Control_Request_Headers": "authorization"}
            reported = Client(made.url).ask("OPTIONS", "/estop", Origin=page, **asked)
            assert (reported.status, reported.headers["access-control-allow-origin"]) == (200, page)
            assert anna.ask("GET", "/services", Origin=page).headers["access-control-allow-origin"] == page
            assert anna.ask("GET", "/services", Origin="http://localhost:5174").status == 403
            with anna.socket(origin=page) as socket:
                assert ask(socket, do="call", id=1, group="robot.a", name="move", args=[1.0])["result"] == 1.0


def test_S21_an_http_gateway_on_a_network_needs_encryption_and_a_policy(tmp_path: Path) -> None:
    tokens = tmp_path / "tokens.toml"
    add_token(tokens, "anna")
    papers = Papers(tmp_path / "pki").of("http")
    with memory_system() as system:
        me = system.container("me")
        with pytest.raises(ConfigurationError, match="--tls"):
            HttpGateway(me, listen="0.0.0.0:0", tokens=Tokens(tokens))
        with pytest.raises(ConfigurationError, match="TRADE_POLICY"):
            HttpGateway(me, listen="0.0.0.0:0", tokens=Tokens(tokens), tls=papers)
        with pytest.raises(ConfigurationError, match="trade http token"):
            HttpGateway(me, listen="127.0.0.1:0", tokens=Tokens(None))
        with pytest.raises(ConfigurationError, match="HOST:PORT"):
            HttpGateway(me, listen="127.0.0.1", tokens=Tokens(tokens))
        with (
            HttpGateway(me, listen="127.0.0.1:0", tokens=Tokens(tokens)) as first,
            pytest.raises(ConfigurationError, match="cannot be used"),
        ):
            HttpGateway(me, listen=first.url.removeprefix("http://"), tokens=Tokens(tokens))


@pytest.mark.real_clock  # TLS is in C
def test_a_certificate_of_the_systems_authority_is_an_identity_and_of_no_other(tmp_path: Path) -> None:
    ours, others = Papers(tmp_path / "pki"), Papers(tmp_path / "other")
    with memory_system() as system:
        robot = Robot(system)
        govern(robot, tmp_path, POLICY)
        with opened(robot.me, tmp_path, tls=ours.of("http", addresses=["127.0.0.1"])) as (made, tokens):
            assert made.url.startswith("https://")
            trust = ssl.create_default_context(cafile=str(tmp_path / "pki" / "ca.pem"))
            token = Client(made.url, add_token(tokens, "bert"), trust=trust)
            assert token.call("robot.a.move", 1.0).body["data"]["who"] == "bert"
            assert Client(made.url, trust=trust).ask("GET", "/services").status == 401
            shown = ours.of("anna")
            trust.load_cert_chain(shown / "cert.pem", shown / "key.pem")
            anna = Client(made.url, trust=trust)
            assert anna.call("robot.a.move", 1.0).status == 200
            with anna.socket(ssl=trust) as page:
                assert ask(page, do="call", id=1, group="robot.a", name="move", args=[1.0])["result"] == 1.0
            foreign = others.of("anna")
            trust.load_cert_chain(foreign / "cert.pem", foreign / "key.pem")
            with pytest.raises(OSError):
                Client(made.url, trust=trust).ask("GET", "/services")


@pytest.mark.real_clock  # TLS is in C
def test_a_client_that_reads_and_writes_in_two_threads_gets_no_ticket_meanwhile(tmp_path: Path) -> None:
    papers = Papers(tmp_path / "pki").of("http", addresses=["127.0.0.1"])
    trust = ssl.create_default_context(cafile=str(papers / "ca.pem"))
    with memory_system() as system, opened(system.container("me"), tmp_path, tls=papers) as (made, _):
        place = urlsplit(made.url)
        plain = socket.create_connection((place.hostname, place.port), timeout=PATIENCE_S)  # type: ignore[arg-type]
        with trust.wrap_socket(plain, server_hostname=place.hostname) as joined:
            joined.sendall(b"GET /me HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert joined.recv(1) == b"H"
            assert joined.version() == "TLSv1.3"
            assert joined.session is None or not joined.session.has_ticket


def test_the_file_of_tokens_has_hashes_alone_and_is_read_as_it_is_now(tmp_path: Path) -> None:
    path = tmp_path / "tokens.toml"
    one = add_token(path, "anna")
    tokens = Tokens(path)
    other = add_token(path, "bert")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert one not in path.read_text()
    assert (tokens.who(one), tokens.who(other), tokens.who("guess"), tokens.who("")) == ("anna", "bert", None, None)
    path.write_text("[tokens\n")
    assert tokens.who(one) == "anna"  # what is wrong changes nothing
    path.write_text("[tokens]\n")
    assert tokens.who(one) is None
    for wrong in ('[tokens]\nshort = "anna"\n', f'[tokens]\n{"a" * 64} = "no name"\n'):
        path.write_text(wrong)
        with pytest.raises(ConfigurationError, match="SHA-256"):
            Tokens(path)
    with pytest.raises(ConfigurationError, match="no identity"):
        add_token(path, "an na")
    with pytest.raises(ConfigurationError, match="trade http token"):
        Tokens(tmp_path / "missing.toml")


def test_no_token_is_in_a_log_or_an_answer(served: Opened, caplog: pytest.LogCaptureFixture) -> None:
    anna, wrong = served.client("anna"), "not-a-token-that-is-known"
    with caplog.at_level(logging.DEBUG):
        refused = Client(served.gateway.url, wrong).ask("GET", "/me")
        assert (refused.status, anna.ask("GET", "/me").status) == (401, 200)
        with anna.socket(subprotocols=["trade.v1", f"bearer.{anna.token}"]) as page:
            say(page, do="nonsense", id=1)
            heard(page)
    reported = [(record.name, record.getMessage()) for record in caplog.records if record.name != "websockets.client"]
    showing = {name for name, text in reported if wrong in text or anna.token in text}
    assert not showing
    assert wrong not in str(refused)
    assert anna.token not in served.tokens.read_text()


@pytest.mark.parametrize(
    "path",
    [
        "/../http-tokens.toml",
        "/..%2f..%2ftokens.toml",
        "/%2e%2e/%2e%2e/tokens.toml",
        "/static/../../_tokens.py",
        "//etc/passwd",
        "/dashboard/..%5c..%5ctokens.toml",
        "/call/..%2f..%2f/x",
        "/locks/..%2f..%2fsession",
    ],
)
def test_no_path_leads_out_of_the_served_folder(served: Opened, path: str) -> None:
    anna = served.client("anna")
    method = "POST" if path.startswith("/call") else "DELETE" if path.startswith("/locks") else "GET"
    answer = anna.ask(method, path, {} if method == "POST" else None)
    assert answer.status in {400, 404, 405}
    assert "root:" not in str(answer.body)
    assert "[tokens]" not in str(answer.body)


@pytest.mark.real_clock  # TLS is in C
@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("asks", ["", "GET /me HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", "nonsense\r\n\r\n"])
def test_a_client_that_breaks_off_leaves_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, asks: str, *, reset: bool
) -> None:
    limit = "trade_gateway.http._protocols._REQUEST_WITHIN_S"
    papers = Papers(tmp_path / "pki").of("http", addresses=["127.0.0.1"])
    trust = ssl.create_default_context(cafile=str(papers / "ca.pem"))
    with memory_system() as system, opened(system.container("me"), tmp_path, tls=papers) as (made, tokens):
        place = urlsplit(made.url)

        def joined() -> ssl.SSLSocket:
            plain = socket.create_connection((place.hostname, place.port), timeout=PATIENCE_S)  # type: ignore[arg-type]
            return trust.wrap_socket(plain, server_hostname=place.hostname)

        monkeypatch.setattr(limit, 0.5)
        with joined() as gone:
            gone.sendall(asks.encode())
            if asks:
                gone.recv(1)
            if reset:
                gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        monkeypatch.setattr(limit, 30.0)  # a busy computer takes a while for it
        with Client(made.url, add_token(tokens, "anna")).socket(ssl=trust):
            pass
        monkeypatch.setattr(limit, 0.5)
        with joined() as later:
            assert later.recv(1) == b""  # closed for asking nothing, and so the wait for the first one is over, too
    assert not [record.getMessage() for record in caplog.records if record.exc_info]
