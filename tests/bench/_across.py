"""Pairs on the networks of a site: ours, and bare zenoh ones whose router has the same regions."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tests.bench._links import Link
from tests.bench._messages import TypedMessages, answer
from tests.bench._peers import BarePair, bare_link, serve_bare
from tests.bench._site import ADDRESSES, SECURE, SYSTEM, Site
from tests.bench._trade import Trade, provider

_PASSWORD = ("bench", "secret")
_NAMESPACE = "bench-bare"
_CALLS, _REPLIES = "call/planner/robot/bare/0/bench/pair", "reply/robot/planner/bare/0"


class TradeAcross(Trade):
    """Our call from one host to another, with certificates and policy or without."""

    def __init__(self, site: Site, name: str, caller: str, port: int, gateway: str = "") -> None:
        """Through the gateway that the caller dials; without one the caller dials the server."""
        self.name = name
        self.group = f"bench.{gateway or 'direct'}-{port}"
        self.server_at, self.caller_at = site.host("robot"), site.host(caller)
        self._system = SYSTEM[port] if gateway else f"{SYSTEM[port]}-direct"
        self._protocol = "tls" if port == SECURE else "tcp"
        robot = f"{ADDRESSES['near']['robot']}:{port}"
        listen = ADDRESSES["near"]["door"] + f":{port}" if gateway else ""
        dialled = next((hosts[gateway] for hosts in ADDRESSES.values() if {gateway, caller} <= {*hosts}), "")
        self._server = ("robot", "127.0.0.1:0" if gateway else robot, listen)
        self._caller = ("planner", "127.0.0.1:0", f"{dialled}:{port}" if gateway else robot)
        self._secure = {who: site.papers(who) for who in ("robot", "planner")} if port == SECURE else {}
        self._policy = site.policy

    @contextmanager
    def serve(self) -> Iterator[str]:
        with self._container(*self._server) as container:
            container.register(provider(), self.group)
            yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        from trade import where

        with self._container(*self._caller) as container:
            yield self.link(container.find(where(name="echo", group=self.group), wait_s=20))

    def _container(self, identity: str, listen: str, dialled: str):
        from trade import Container, Settings

        folder = self._secure.get(identity)
        how: dict[str, Any] = {"credentials": _PASSWORD, "insecure_lan": True}
        if folder:
            how = {"tls": folder, "policy": self._policy}
        return Container(
            Settings.read(
                system=self._system,
                container=self.group,
                listen=[f"{self._protocol}/{listen}"],
                connect=[f"{self._protocol}/{dialled}"] if dialled else [],
                **how,
            )
        )


class BareAcross(BarePair):
    """What our calls through a gateway stand on: zenoh alone, and a router with the same regions."""

    def __init__(
        self, site: Site, name: str, port: int, *, tls: bool = False, rules: bool = False, typed: bool = False
    ) -> None:
        """With ``typed``, what it carries are the two messages of a call, encoded and decoded at both ends."""
        self.name = name
        self._typed = typed
        self.server_at, self.caller_at, self.router_at = site.host("robot"), site.host("office"), site.host("door")
        self._protocol = "tls" if tls else "tcp"
        self._own = f"{self._protocol}/127.0.0.1:{port}"
        self._endpoints = [f"{self._protocol}/{ADDRESSES[network]['door']}:{port}" for network in ("near", "far")]
        self._papers = {who: site.papers(who) for who in ("robot", "planner", "door")} if tls else {}
        self._policy = site.policy if rules else None

    @contextmanager
    def serve(self) -> Iterator[str]:
        with self._session("robot", connect=self._endpoints[:1]) as session:
            serve_bare(session, _CALLS, _REPLIES, answer if self._typed else bytes)
            yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with self._session("planner", connect=self._endpoints[1:]) as session:
            link = bare_link(session, _CALLS, _REPLIES)
            yield TypedMessages(link) if self._typed else link

    def route(self, pipe: Connection) -> None:
        """Be the router until the pipe ends."""
        with self._session("door", listen=self._endpoints, bridge=[["near", "lo"], ["far"]]):
            pipe.send("up")
            pipe.poll(None)

    def _session(
        self,
        identity: str,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        bridge: Sequence[Sequence[str]] = (),
    ):
        folder = self._papers.get(identity)
        return bare_session(listen or [self._own], connect, folder, self._policy, bridge=bridge)


def bare_session(
    listen: Sequence[str],
    connect: Sequence[str],
    papers: Path | None,
    policy: Path | None,
    *,
    namespace: str = _NAMESPACE,
    bridge: Sequence[Sequence[str]] = (),
):
    """A zenoh session with TRADE's settings, without a container around it."""
    from trade._security.certificates import Certificate
    from trade.policies import acl, read_policy
    from trade.transport.zenoh import configuration
    from trade.transport.zenoh_links import open_session

    return open_session(
        configuration(
            namespace=namespace,
            listen=listen,
            connect=connect,
            certificate=Certificate.read(papers) if papers else None,
            bridge=bridge,
            rules=acl(read_policy(policy), namespace=namespace) if policy else {},
        )
    )
