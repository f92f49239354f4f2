"""A robot's private network and a public one, with ``trade gateway`` between them, and containers on both."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.support.certificates import Papers
from tests.system.networks import MEMBER, Member, Networks

SYSTEM = "lab-0"
"""The one that the gateway is of; ``member.py`` appends its turn."""
GATEWAY = {"private": "tls/10.231.1.1:7450", "public": "tls/10.231.2.1:7450"}
"""Where the gateway listens."""
_HOSTS = {"left": ("private", "10.231.1.2"), "right": ("public", "10.231.2.2"), "right2": ("public", "10.231.2.3")}


class GatewayHost:
    """Hosts in networks, one of which, ``between``, runs ``trade gateway`` in a process."""

    networks: Networks
    folder: Path
    file: Path
    through: Sequence[str] = ()
    """A script, with its words, that runs the gateway when it is started the next time."""
    members: list[Member]

    def begin(self) -> None:
        """Start the gateway; it is up then."""
        command = ["ip", "netns", "exec", self.networks.host("between")]
        command += [sys.executable, *self.through, "-m", "trade_gateway", "gateway", str(self.file), "--json"]
        complaints = (self.folder / "complaints").open("ab")
        with complaints:
            self.gateway = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=complaints,
                text=True,
                env={**os.environ, "TRADE_RUNTIME_DIR": str(self.folder / "runtime"), "TRADE_SYSTEM": "elsewhere"},
            )
        self.ready = self.said()

    def said(self) -> dict[str, object]:
        """The next that the gateway says."""
        assert self.gateway.stdout is not None
        return json.loads(self.gateway.stdout.readline())

    def end(self, how: signal.Signals) -> None:
        self.gateway.send_signal(how)
        try:
            self.gateway.wait(20)
        finally:
            self.gateway.kill()
            self.gateway.wait()
            assert self.gateway.stdout is not None
            self.gateway.stdout.close()

    def complaints(self) -> str:
        return (self.folder / "complaints").read_text()

    def close(self) -> None:
        for each in self.members:
            each.close()
        self.end(signal.SIGTERM)


class Site(GatewayHost):
    """Hosts ``left`` on the private network, ``between`` with the gateway, ``right`` and ``right2`` on the public one.

    Args:
        networks: not laid yet; their creator closes them.
        folder: for certificates and files; paths in a policy are beside it.
        policy: the policy of all, as text.
        public: the groups that the public network lets into the private one, which lets out ``rosie.arm`` in turn, or
            what ``private`` says.
        private: see there.
    """

    def __init__(
        self, networks: Networks, folder: Path, policy: str, public: str = "[]", private: str = '["rosie.arm"]'
    ) -> None:
        self.networks = networks
        self.folder = folder
        self.papers = Papers(folder / "pki")
        self.policy, self.file = folder / "policy.toml", folder / "gateway.toml"
        self.policy.write_text(policy)
        self.file.write_text(_gateway_file(public, private))
        self.members: list[Member] = []
        at = {host: address for host, (_, address) in _HOSTS.items()}
        networks.lay("net1", between="10.231.1.1", left=at["left"])
        networks.lay("net2", between="10.231.2.1", right=at["right"], right2=at["right2"])
        self.papers.of("door", addresses=["10.231.1.1", "10.231.2.1"], purpose="gateway")
        self.begin()

    def launched(
        self,
        host: str,
        name: str,
        *,
        identity: str = "",
        policy: Path | None = None,
        script: Path = MEMBER,
        reachable: bool = False,
        through: Sequence[str] = (),
    ) -> Member:
        """A member process, without any command yet.

        Args:
            host: where.
            name: of its container.
            identity: its name unless said.
            policy: that it goes by; the site's unless said.
            script: in place of ``member.py``.
            reachable: whether others of its network can dial it.
            through: another script, with its words, that runs this one.
        """
        own = self.folder / f"{name}.toml"
        own.write_text(self.policy.read_text())
        address = _HOSTS[host][1] if reachable else "127.0.0.1"
        made = Member(
            self.networks.host(host),
            name,
            f"{address}:0",
            self.folder / "runtime",
            tls=self.papers.of(identity or name, addresses=[address]),
            policy=policy or own,
            script=script,
            system=SYSTEM.removesuffix("-0"),
            through=through,
        )
        self.members.append(made)
        return made

    def member(self, host: str, name: str, *, identity: str = "", policy: Path | None = None) -> Member:
        """A container that is linked to the gateway."""
        made = self.launched(host, name, identity=identity, policy=policy)
        made.ask("start", GATEWAY[_HOSTS[host][0]])
        return made

    def change(self, path: Path, before: str, after: str) -> None:
        text = path.read_text()
        assert before in text
        path.write_text(text.replace(before, after))


def _gateway_file(public: str, private: str) -> str:
    return f"""
system = "{SYSTEM}"
tls = "pki/issued/door"
policy = "policy.toml"

[network.private]
interface = "net1"
listen = ["{GATEWAY["private"]}"]
export = {private}

[network.public]
interface = "net2"
listen = ["{GATEWAY["public"]}"]
export = {public}
"""
