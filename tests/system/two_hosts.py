"""Two hosts with a gateway each that share one container, what may befall them, and where its object was alive."""

import contextlib
import os
import signal
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.system.networks import PATIENCE_S, Networks, ip

LEASE_S: Final = 3.0
ADDRESSES: Final = {"rover": "10.231.8.1", "base": "10.231.8.2"}
MODULE: Final = """
import os, struct, threading, time
from trade import service

class Mind:
    \"\"\"Says every 5 ms that it is alive, by a clock that all processes of this kernel share, and counts that.\"\"\"

    def __init__(self, folder, host):
        self.total = 0
        self.first = time.monotonic()
        self.file = os.open(f"{folder}/{host}-{os.getpid()}.beats", os.O_RDWR | os.O_CREAT)
        self.began_with = 0
        self.over = threading.Event()
        threading.Thread(target=self.beat, daemon=True).start()

    def beat(self):
        while not self.over.wait(0.005):
            self.total += 1
            said = struct.pack("4d", self.first, time.monotonic(), self.began_with, self.total)
            os.pwrite(self.file, said, 0)

    @service(effect="read")
    def shown(self) -> int:
        return self.total

    def save_state(self):
        return {"total": self.total}

    def restore_state(self, state):
        self.total = self.began_with = state["total"]

    def close(self):
        self.over.set()
"""
POLICY: Final = policy_text(
    "rover=gateway base=gateway chief=gateway mind=mind",
    head='gateways = ["rover", "base"]\n',
    gateway="read=* administer=* register=trade",
    mind="register=hall",
)


@dataclass(frozen=True)
class Life:
    """Of one object, from its first beat to its last."""

    host: str
    first: float
    last: float
    began_with: int
    total: int


class TwoHosts:
    """``rover`` leases a container from ``base``; the cable between them can be pulled.

    Args:
        networks: not laid yet.
        folder: for all files.
        system: its id.
        mind: more of the container's table, by host.
    """

    def __init__(self, networks: Networks, folder: Path, system: str, **mind: str) -> None:
        self._networks = networks
        self._folder = folder
        self._system = system
        networks.lay("cable", **ADDRESSES)
        self._papers = Papers(folder / "pki")
        (folder / "policy.toml").write_text(POLICY)
        (folder / "beats.py").write_text(MODULE)
        self._papers.of("mind")
        for name, address in ADDRESSES.items():
            self._papers.of(name, addresses=[address], purpose="gateway")
        lease = {"rover": 'lease_from = "base"', "base": f'stands_in_for = "rover"\nlease_s = {LEASE_S}'}
        reach = {
            "rover": f'connect = ["tls/{ADDRESSES["base"]}:7450"]',
            "base": '[network.inside]\ninterface = "lo"\nlisten = ["tls/127.0.0.1:7451"]',
        }
        for name, address in ADDRESSES.items():
            (folder / f"{name}.toml").write_text(f"""
system = "{system}"
name = "{name}"
tls = "pki/issued/{name}"
policy = "policy.toml"
{reach[name]}

[network.lan]
interface = "cable"
listen = ["tls/{address}:7450"]

[container.mind]
tls = "pki/issued/mind"
{lease[name]}
save_every_s = 1
restarts = 1000
providers = [{{ class = "beats:Mind", groups = ["hall"], args = ["{folder}", "{name}"] }}]
{mind.get(name, "")}
""")
        self._gateways: dict[str, subprocess.Popen[bytes]] = {}
        for name in ("base", "rover"):
            self.begin(name)

    def begin(self, host: str) -> None:
        """Start a gateway."""
        words = ["-m", "trade_gateway", "gateway", str(self._folder / f"{host}.toml"), "--json"]
        command = ["ip", "netns", "exec", self._networks.host(host), sys.executable, *words]
        with (self._folder / f"{host}.said").open("ab") as said:
            self._gateways[host] = subprocess.Popen(
                command, stdout=said, stderr=said, env=self._environment(host), start_new_session=True
            )

    def kill(self, host: str) -> None:
        """Its gateway, at once."""
        self._gateways[host].kill()
        self._gateways[host].wait(PATIENCE_S)

    def freeze(self, host: str) -> None:
        """Its gateway alone."""
        self._gateways[host].send_signal(signal.SIGSTOP)

    def thaw(self, host: str) -> None:
        """Its gateway, if it was frozen."""
        self._gateways[host].send_signal(signal.SIGCONT)

    def freeze_all(self, host: str) -> None:
        """All its processes; the gateway first, so that it has notified no other when others freeze."""
        self.freeze(host)
        for pid in ip("netns", "pids", self._networks.host(host)).split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGSTOP)

    def thaw_all(self, host: str) -> None:
        for pid in ip("netns", "pids", self._networks.host(host)).split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGCONT)

    def kill_mind(self, host: str) -> None:
        """The container, if it exists."""
        for child in self._children(host):
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)

    def _children(self, host: str) -> list[int]:
        gateway = self._gateways[host].pid
        pids = [int(pid) for pid in ip("netns", "pids", self._networks.host(host)).split()]
        return [pid for pid in pids if pid != gateway]

    def pull(self) -> None:
        """At the switch: neither end is notified."""
        ip("-n", self._networks.host("cable-switch"), "link", "set", "rover", "down")

    def plug(self) -> None:
        ip("-n", self._networks.host("cable-switch"), "link", "set", "rover", "up")

    def lives(self) -> list[Life]:
        """Of all objects there ever were, by their first beat."""
        found: list[Life] = []
        for file in self._folder.glob("*.beats"):
            if len(said := file.read_bytes()) == struct.calcsize("4d"):
                first, last, began_with, total = struct.unpack("4d", said)
                found.append(Life(file.name.partition("-")[0], first, last, int(began_with), int(total)))
        return sorted(found, key=lambda life: life.first)

    def up(self, host: str, since: float) -> Life:
        """Wait until there is an object on a host that is alive after that moment."""
        found: list[Life] = []

        def is_known() -> bool:
            found[:] = [life for life in self.lives() if life.host == host and life.last > since]
            return bool(found)

        self._wait(is_known, f"it is on {host}")
        return found[-1]

    def begins_with(self, life: Life, known: int) -> None:
        """Wait until an object has its state, which it is given after its first beat, and that is no older."""

        def has_it() -> bool:
            return any(one.first == life.first and one.began_with >= known for one in self.lives())

        self._wait(has_it, f"what is up on {life.host} begins with {known} at least")

    def saved(self) -> int:
        """The count that base knows."""
        [file] = (self._folder / "state-base").rglob("*.state.sqlite")
        with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True, timeout=5)) as store:
            rows = store.execute("select blob from state where container = 'mind'").fetchall()
        return max((msgspec.msgpack.decode(blob)["total"] for (blob,) in rows), default=-1)

    def save_after(self, moment: float) -> int:
        """Wait until base knows what an object that is alive after a moment counted after it; that count."""
        base = max((life.total for life in self.lives() if life.last > moment), default=0)
        self._wait(lambda: self.saved() > base, f"base knows more than {base}")
        return self.saved()

    def _wait(self, true: Callable[[], object], what: str) -> None:
        try:
            wait_until(true, what)
        except AssertionError as late:
            raise AssertionError(f"{late}; {self.lives()[-4:]}; {self.complaints()}") from None

    def hand_back(self) -> "subprocess.CompletedProcess[str]":
        words = ["call", "trade.hand_back_child", '"mind"', "--container", "base"]
        return self.trade("base", *words)

    def trade(self, host: str, *words: str) -> "subprocess.CompletedProcess[str]":
        """``trade WORDS`` on a host, by who may do everything."""
        environment = self._environment(host) | {
            "TRADE_TLS": str(self._papers.of("chief")),
            "TRADE_POLICY": str(self._folder / "policy.toml"),
            "TRADE_SYSTEM": self._system,
        }
        command = ["ip", "netns", "exec", self._networks.host(host), sys.executable, "-m", "trade_gateway", *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environment)

    def _environment(self, host: str) -> dict[str, str]:
        places = {"TRADE_RUNTIME_DIR": f"run-{host}", "TRADE_STATE_DIR": f"state-{host}"}
        return {**os.environ, **{name: str(self._folder / place) for name, place in places.items()}}

    def seen(self) -> str:
        """What each gateway says of its children, whom it sees, and which links there are."""
        asked = (("call", "trade.children"), ("containers",))
        said = [f"{host}: {self.trade(host, *words).stdout}" for host in ADDRESSES for words in asked]
        return "\n".join([*said, *(ip("netns", "exec", self._networks.host(host), "ss", "-tno") for host in ADDRESSES)])

    def complaints(self) -> str:
        """What both gateways said last."""
        said = {host: (self._folder / f"{host}.said").read_text()[-2000:] for host in ADDRESSES}
        return "\n".join(f"{host}: {text}" for host, text in said.items())

    def close(self) -> None:
        for host, gateway in self._gateways.items():
            self.thaw_all(host)
            gateway.terminate()
        for host, gateway in self._gateways.items():
            try:
                gateway.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                gateway.kill()
                gateway.wait()
            wait_until(lambda host=host: not self._children(host), f"nothing is left on {host}")


def overlaps(lives: list[Life]) -> list[tuple[Life, Life]]:
    """Pairs that were alive at the same moment; ``lives`` by their first beat."""
    return [(one, other) for n, one in enumerate(lives) for other in lives[n + 1 :] if other.first <= one.last]


@contextlib.contextmanager
def two_hosts(networks: Networks, folder: Path, system: str, **mind: str) -> Iterator[TwoHosts]:
    made = TwoHosts(networks, folder, system, **mind)
    try:
        yield made
    finally:
        made.close()


def now() -> float:
    return time.monotonic()
