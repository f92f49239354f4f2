"""The demo's networks: the robot's, the laboratory's and a gateway between them. They are removed at the end.

With root and `ip`, they are network namespaces that only the gateway connects. Otherwise everything uses loopback
addresses, and each side has its own gateway, linked to the other one.
"""

import contextlib
import ctypes
import os
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from demo_actor import PATIENCE_S, Actor, DemoFailed

from trade_drivers import Bus, Driver, load, load_driver
from trade_gateway.pki._authority import Authority

HERE = Path(__file__).parent
ROBOT = HERE / "rosie.toml"
RECORD_HZ = "20"
"""Samples of joints a second: less than the slowest bus measures, so that two processors do for all of this."""
_LAST = 20
_NEW_NETWORK = 0x40000000
"""CLONE_NEWNET of setns(2)."""

POLICY = """
gateways = ["door", "lab-door"]        # they check what they forward

[roles.driver]
register = ["rosie"]

[roles.viewer]
read = ["*"]

[roles.operator]
includes = ["viewer"]
call = ["rosie"]
lock = ["rosie"]

[roles.recorder]
includes = ["viewer"]
instrument = ["trade"]                 # to trace calls

[roles.chief]
administer = ["*"]

[identities]
rosie = ["driver"]
planner = ["operator"]                 # the behaviours
visitor = ["viewer"]
keeper = ["chief", "operator"]         # creates and saves objects in its children
anna = ["operator", "chief"]           # the demo itself
archive = ["recorder"]                 # records, with --record
"""


KEEPER = """
system = "{system}"
name = "keeper"
tls = "pki/issued/keeper"
policy = "policy.toml"
connect = ["{door}"]

[container.head]
robot = "{head}"
tls = "pki/issued/rosie"
connect = ["{door}"]

[container.lamp]
providers = [{{ class = "lamp:Lamp", groups = ["rosie.lamp"] }}]
tls = "pki/issued/rosie"
connect = ["{door}"]
save_every_s = 1
"""


class Stage:
    """Both networks with everything that is needed to act on them."""

    def __init__(self, folder: Path, places: "Loopback | Namespaces") -> None:
        self.folder = folder
        self.places = places
        self.system = f"demo-{secrets.token_hex(3)}"
        self._complaints = folder / "complaints"
        self.left_out = {bus.name: missing for bus in load(ROBOT).buses if (missing := _missing(bus))}
        """Buses of the robot whose driver lacks a library, and which; not every vendor has one for every platform."""

    def complaints(self) -> list[str]:
        """The latest warnings of the robot and the gateway."""
        return self._complaints.read_text().splitlines(keepends=True)[-_LAST:]

    def environment(self, side: str, who: str) -> dict[str, str]:
        """The settings of a container on the robot's side or the lab's: the ordinary TRADE_ variables."""
        return {
            "TRADE_SYSTEM": self.system,
            "TRADE_TLS": str(self.folder / "pki" / "issued" / who),
            "TRADE_POLICY": str(self.folder / "policy.toml"),
            "TRADE_CONNECT": self.places.door[side],
            "TRADE_RUNTIME_DIR": str(self.folder / side),
            "TRADE_STATE_DIR": str(self.folder / f"{side}-state"),
        }

    @contextlib.contextmanager
    def robot(self, log: Path, file: Path = ROBOT) -> Generator[dict[str, Any]]:
        """Rosie with simulated devices, on her own network; yields what she says when she is up."""
        words = [*_TRADE, "up", file, "--sim", "--sim-log", log, "--json"]
        words += [word for bus in self.left_out for word in ("--without", bus)]
        with self._started("rosie", words, self.environment("robot", "rosie"), "robot") as rosie:
            yield rosie.ready()

    @contextlib.contextmanager
    def recorder(self, file: Path, robot: Path) -> Generator[None]:
        """All that happens on the robot's network goes to a file, from now on until this ends."""
        words = [*_TRADE, "record", file, "--hz", RECORD_HZ, "--attach", robot, "--json"]
        with self._started("trade record", words, self.environment("robot", "archive"), "robot") as recording:
            recording.ready()
            yield

    def behaviour(self, program: str, *role: str) -> contextlib.AbstractContextManager[Actor]:
        """One of the examples, on the laboratory's network."""
        words = [sys.executable, "-u", HERE / program, *role]
        return self._started(" ".join((program, *role)), words, self.environment("lab", "planner"))

    def trade(self, who: str, *words: str | Path) -> contextlib.AbstractContextManager[Actor]:
        """A long-running command of a user in the laboratory."""
        return self._started(f"trade {words[0]}", [*_TRADE, *words], self.environment("lab", who))

    def command(self, who: str, *words: str) -> str:
        """The output of `trade WORDS` as a user in the laboratory sees it, with its errors."""
        environment = {**os.environ, **self.environment("lab", who)}
        ended = subprocess.run(
            [*_TRADE, *words],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        return ended.stdout.strip()

    @contextlib.contextmanager
    def gateway(self, file: Path) -> Generator[None]:
        environment = {"TRADE_RUNTIME_DIR": str(self.folder / file.stem)}
        with self._started(file.stem, [*_TRADE, "gateway", file, "--json"], environment, "gateway") as door:
            door.ready()
            yield

    @contextlib.contextmanager
    def keeper(self, head: Path) -> Generator[None]:
        """A gateway on the robot's network that supervises a driver and a lamp; its state is in its folder."""
        door = self.places.door["robot"]
        (self.folder / "keeper.toml").write_text(KEEPER.format(system=self.system, door=door, head=head))
        known = self.environment("robot", "keeper")
        environment = {name: known[name] for name in ("TRADE_RUNTIME_DIR", "TRADE_STATE_DIR")}
        environment["PYTHONPATH"] = str(HERE)  # where lamp.py is
        words = [*_TRADE, "gateway", self.folder / "keeper.toml", "--json"]
        with self._started("keeper", words, environment, "robot") as keeper:
            keeper.ready()
            yield

    @contextlib.contextmanager
    def _started(
        self, name: str, words: Sequence[str | Path], environment: Mapping[str, str], place: str = ""
    ) -> Generator[Actor]:
        with contextlib.ExitStack() as files:
            # What drivers and gateways warn of is shown if something fails; what behaviours complain of, at once.
            complaints = files.enter_context(self._complaints.open("a")) if place else None
            actor = Actor(name, [*self.places.inside(place), *words], environment, complaints)
        try:
            yield actor
        finally:
            actor.close()


_TRADE = (sys.executable, "-m", "trade_gateway")


@contextlib.contextmanager
def stage(folder: Path, *, loopback: bool, policy: str = POLICY) -> Generator[Stage]:
    """Lay the networks, make certificates and a policy, open the gateway, and step onto the laboratory's network."""
    why = "as you said --loopback" if loopback else why_no_namespaces()
    with contextlib.ExitStack() as undo:
        places = Loopback(why) if why else Namespaces(undo)
        made = Stage(folder, places)
        (folder / "policy.toml").write_text(policy)
        authority = Authority.create(folder / "pki")  # what `trade pki init` and `trade pki issue` do
        for name in ("rosie", "planner", "visitor", "keeper", "anna", "archive"):
            authority.issue(name)
        for name, text in places.gateway_files(made.system).items():
            authority.issue(name, purpose="gateway", addresses=places.addresses)
            (folder / f"{name}.toml").write_text(text)
            undo.enter_context(made.gateway(folder / f"{name}.toml"))
        places.step_into_the_lab()
        before = dict(os.environ)
        undo.callback(_restore, before)
        os.environ.update(made.environment("lab", "anna"))
        yield made


def _missing(bus: Bus) -> str:
    return ", ".join(load_driver(bus.driver, bus.name, Driver).missing())


def _restore(environment: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(environment)


class Loopback:
    """Two networks by convention: only the gateways connect to the other side."""

    addresses = ("127.0.0.1",)
    window: socket.socket | None = None
    """What a browser of this host connects to needs no way around."""

    def __init__(self, why: str) -> None:
        self.why = why
        robot, lab = _free_ports(2)
        self.door = {"robot": f"tls/127.0.0.1:{robot}", "lab": f"tls/127.0.0.1:{lab}"}

    def description(self) -> list[str]:
        return [
            f"The networks are loopback addresses of this host, {self.why}.",
            f"  {self.door['robot']}  the robot's gateway, named door: it lets the others see rosie",
            f"  {self.door['lab']}  the laboratory's gateway, linked to the first",
        ]

    def gateway_files(self, system: str) -> dict[str, str]:
        """By name; each dials the other one."""
        door, lab = self.door["robot"], self.door["lab"]
        return {
            "door": _gateway_file(system, "door", ("lo", door, '["rosie"]'), connect=lab),
            "lab-door": _gateway_file(system, "lab-door", ("lo", lab, ""), connect=door),
        }

    def inside(self, place: str) -> list[str]:  # noqa: ARG002 - all places are this one
        return []

    def step_into_the_lab(self) -> None:
        """Nothing to do: all networks are this host."""

    def way_in(self) -> str:
        return ""


class Namespaces:
    """Two network namespaces, connected only by a gateway."""

    addresses = ("192.168.7.1", "10.0.0.7")

    def __init__(self, undo: contextlib.ExitStack) -> None:
        mark = secrets.token_hex(3)
        self.window: socket.socket | None = undo.enter_context(socket.create_server(("127.0.0.1", 0)))
        """Listens on this host's own network, also when we have stepped into another one."""
        self._names = {place: f"trade-demo-{mark}-{place}" for place in ("robot", "gateway", "lab")}
        self.door = {"robot": "tls/192.168.7.1:7450", "lab": "tls/10.0.0.7:7450"}
        for name in self._names.values():
            _ip("netns", "add", name)
            undo.callback(_ip, "netns", "del", name)
            _ip("-n", name, "link", "set", "lo", "up")
        self._lay("eth0", "192.168.7.1", "robot", "192.168.7.2")
        self._lay("eth1", "10.0.0.7", "lab", "10.0.0.2")

    def _lay(self, interface: str, address: str, place: str, there: str) -> None:
        """A cable from an interface of the gateway to eth0 of a place."""
        gateway, other = self._names["gateway"], self._names[place]
        _ip("-n", gateway, "link", "add", interface, "type", "veth", "peer", "name", "eth0", "netns", other)
        for name, link, own in ((gateway, interface, address), (other, "eth0", there)):
            _ip("-n", name, "addr", "add", f"{own}/24", "dev", link)
            _ip("-n", name, "link", "set", link, "up")

    def description(self) -> list[str]:
        return [
            "The networks are network namespaces: they have no way to each other but the gateway.",
            f"  {self._names['robot']:<27} 192.168.7.2  rosie",
            f"  {self._names['gateway']:<27} 192.168.7.1 and 10.0.0.7: lets the laboratory see rosie",
            f"  {self._names['lab']:<27} 10.0.0.2     the behaviours, and this program",
        ]

    def gateway_files(self, system: str) -> dict[str, str]:
        feet = (("eth0", self.door["robot"], '["rosie"]'), ("eth1", self.door["lab"], "[]"))
        return {"door": _gateway_file(system, "door", *feet)}

    def inside(self, place: str) -> list[str]:
        """What to write before a command that is to run there; nothing where we are."""
        return ["ip", "netns", "exec", self._names[place]] if place else []

    def step_into_the_lab(self) -> None:
        """From here on this process, and each thread and process it starts, is on the laboratory's network."""
        with Path("/run/netns", self._names["lab"]).open() as network:
            if ctypes.CDLL(None, use_errno=True).setns(network.fileno(), _NEW_NETWORK):
                raise DemoFailed(f"cannot step into {self._names['lab']}: {os.strerror(ctypes.get_errno())}")

    def way_in(self) -> str:
        return f"ip netns exec {self._names['lab']} bash"


def why_no_namespaces() -> str:
    """Why there can be no network namespaces; empty if there can."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "as network namespaces need root"
    if shutil.which("ip") is None:
        return "as there is no `ip` (Debian: apt-get install iproute2)"
    probe = f"trade-demo-{secrets.token_hex(3)}"
    try:
        _ip("netns", "add", probe)
        _ip("netns", "del", probe)
    except (subprocess.SubprocessError, OSError):
        return "as this host refuses network namespaces"
    return ""


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], capture_output=True, check=True, timeout=PATIENCE_S)


def _free_ports(count: int) -> list[int]:
    """Free ports of 127.0.0.1; the system does not hand out the same one again soon."""
    with contextlib.ExitStack() as held:
        found = [held.enter_context(socket.socket()) for _ in range(count)]
        for each in found:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in found]


def _gateway_file(system: str, name: str, *feet: tuple[str, str, str], connect: str = "") -> str:
    """A gateway file, from the interface, the endpoint and the exports of each network."""
    lines = [f'system = "{system}"', f'name = "{name}"', f'tls = "pki/issued/{name}"', 'policy = "policy.toml"']
    lines += [f'connect = ["{connect}"]'] if connect else []
    for interface, endpoint, exports in feet:
        lines += ["", f'[network."{interface}"]', f'interface = "{interface}"', f'listen = ["{endpoint}"]']
        lines += [f"export = {exports}"] if exports else []
    return "\n".join(lines) + "\n"
