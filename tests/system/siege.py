"""The siege: two simulated robots on one host, a gateway on another, clients on two more, and all their troubles.

One joint is a drive on a CAN bus, the others are servos on serial buses.

Clients are containers, a dashboard's page and an agent; they reach the gateway through `slow_wire`.
"""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final
from unittest import mock

import psutil

from tests.support.lock_log import Log
from tests.support.policies import policy_text
from tests.system import wall_clock
from tests.system.networks import Member, Networks, ip
from tests.system.siege_records import CAN_BUS, Alarm, Fault, Rescue
from tests.system.sites import GATEWAY, SYSTEM, Site
from trade_gateway.http import add_token
from trade_hil_sim import BusOff, SimProcess

_HERE: Final = Path(__file__).parent
_KINDS: Final = ("planner", "planner", "planner", "planner", "page", "agent")
"""Of clients, by slot."""
_SCRIPTS: Final = {
    "planner": _HERE / "planner.py",
    "page": _HERE / "outsiders.py",
    "agent": _HERE / "outsiders.py",
}
_WIRE: Final = "10.231.2.1:7451"
_HALL: Final = "127.0.0.1:7480"
"""Where pages come in, on their own host."""
_DISK_BYTES: Final = 4 << 20
_JUMPS_S: Final = (-36_000.0, -5.0, 5.0, 36_000.0)
_STRANGERS: Final = 200
"""So many come in a second, and so many stay."""
_LEFT_S: Final = 20.0
"""When they have left, the transport ends ten of what they left a second; no new link is made before."""
_RESCUE_S: Final = 10.0
_ESTOPS: Final = 200
"""Of one flood."""
_CLEARED_S: Final = 10.0
_HELD_BACK_S: Final = 15.0
_CLEARED_AGAIN_S: Final = 2.0
_LONG_S: Final = 60.0
"""Of a siege: one in which there is time to come to rest between troubles."""
_WHO: Final = [
    *(f"{kind}{slot}" for slot, kind in enumerate(_KINDS)),
    "hall",
    "anna",
]
_POLICY: Final = policy_text(
    " ".join(["rosie=driver dora=driver warden=warden", *(f"{who}=operator" for who in _WHO)]),
    head='gateways = ["door"]\n',
    driver="register=rosie,dora",
    operator="read=* call=rosie,dora lock=rosie,dora",
    warden="administer=*",
)
_JOINT: Final = """
[joint."{name}"]
bus = "{bus}"
id = {id}
{model}
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
_SERVO: Final = ('driver = "dynamixel"\nport = "NOWHERE"', 'model = "XL430-W250"')
_DRIVE: Final = (
    'driver = "cia402"\ninterface = "socketcand"\nchannel = "NOWHERE"',
    'model = "ACME-EC60"\ncounts_per_rev = 4096\ngear = 1',
)
"""It has as many counts as a servo, so clients say of both in the same way where to."""
_ROBOTS: Final = {
    "rosie": {"neck": (_SERVO, ("pan", "tilt"))},
    "dora": {"arm": (_SERVO, ("elbow",)), CAN_BUS: (_DRIVE, ("hip",))},
}


def _robot_file(robot: str, patience: str, ports: Mapping[str, str] = {}) -> str:
    """Of a robot; before its devices exist, the places of its buses are unknown."""
    text = f'[robot]\nname = "{robot}"\n'
    for bus, ((driver, model), joints) in _ROBOTS[robot].items():
        port = ports.get(bus, "can0" if bus == CAN_BUS else "/dev/ttyNOWHERE").removeprefix("socketcand:")
        text += f"\n[bus.{bus}]\n{driver.replace('NOWHERE', port)}\n{patience}\n"
        text += "".join(
            _JOINT.format(name=f"{bus}.{joint}", bus=bus, id=number, model=model)
            for number, joint in enumerate(joints, 1)
        )
    return text


class Kept:
    """A process on a host that is started again whenever it does not run: it is killed, or ends by itself.

    Args:
        site: of which host.
        host: its name there.
        identity: whose certificate it has.
        connect: where it finds the others.
        command: what is run, for Python.
    """

    def __init__(self, site: Site, host: str, identity: str, connect: str, command: Sequence[str]) -> None:
        self._command = ["ip", "netns", "exec", site.networks.host(host), sys.executable, *command]
        self._settings = {
            "TRADE_SYSTEM": SYSTEM,
            "TRADE_TLS": str(site.papers.of(identity)),
            "TRADE_POLICY": str(site.folder / "kept.toml"),
            "TRADE_CONNECT": connect,
            "TRADE_RUNTIME_DIR": str(site.folder / "runtime" / identity),
            "TRADE_STATE_DIR": str(site.folder / "disk" / identity),
        }
        self._complaints = (site.folder / f"{identity}.complaints").open("ab")
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = threading.Event()
        self._keeper = threading.Thread(target=self._keep)
        self._keeper.start()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _keep(self) -> None:
        while not self._closed.wait(0.5):
            if self._process is None or self._process.poll() is not None:
                self._process = subprocess.Popen(
                    self._command,
                    stdout=subprocess.DEVNULL,
                    stderr=self._complaints,
                    env={**os.environ, **self._settings},
                )

    def close(self) -> None:
        self._closed.set()
        self._keeper.join()
        if self._process is not None:
            self._process.kill()
            self._process.wait(20)
        self._complaints.close()


def _python_on(site: Site, host: str) -> Path:
    """A Python that runs on that host: sockets of the simulator are there."""
    script = site.folder / f"python-on-{host}"
    script.write_text(f'#!/bin/sh\nexec ip netns exec {site.networks.host(host)} {sys.executable} "$@"\n')
    script.chmod(0o755)
    return script


class Driver(Kept):
    """A robot's simulated devices, and beside them its driver, whose wall clock can be shifted.

    Args:
        site: where they are.
        robot: ``rosie`` or ``dora``.
        mutant: what is broken in its driver, or nothing.
        patience: keys of each bus: for how long devices and driver bear to hear nothing of each other.
    """

    def __init__(self, site: Site, robot: str, mutant: str = "", patience: str = "watchdog_s = 0.5") -> None:
        self.robot = robot
        self.clock = site.folder / f"{robot}.clock"
        wall_clock.shift(self.clock, 0.0)
        file = site.folder / f"{robot}.toml"
        file.write_text(_robot_file(robot, patience))
        with mock.patch.object(sys, "executable", str(_python_on(site, "left"))):
            self.sim = SimProcess(file)
        file.write_text(_robot_file(robot, patience, self.sim.ports))
        program = [str(_HERE / "broken_driver.py"), mutant] if mutant else ["-m", "trade_gateway"]
        self._file = file
        super().__init__(site, "left", robot, GATEWAY["private"], self._words(program))

    def _words(self, program: Sequence[str]) -> list[str]:
        return [str(_HERE / "wall_clock.py"), str(self.clock), *program, "up", str(self._file), "--json"]

    def run_from_now_on(self, program: Sequence[str]) -> None:
        """What is run when it is started the next time, for Python."""
        self._command = [*self._command[: self._command.index(sys.executable) + 1], *self._words(program)]

    def close(self) -> None:
        super().close()
        self.sim.close()


class Disk:
    """A small one in memory, at a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder
        size = f"size={_DISK_BYTES}"
        subprocess.run(["mount", "-t", "tmpfs", "-o", size, "siege", str(folder)], check=True, timeout=20)

    def fill(self) -> None:
        with suppress(OSError), (self._folder / "full").open("wb", buffering=0) as file:  # it is, at some time
            while file.write(bytes(1 << 12)):
                pass

    def free(self) -> None:
        (self._folder / "full").unlink()

    def close(self) -> None:
        subprocess.run(["umount", "--lazy", str(self._folder)], check=True, timeout=20)


class Stand:
    """All of it. Troubles come from one seed; each is noted with how long it lasted."""

    def __init__(self, networks: Networks, folder: Path, disk: Disk, seed: int, mutant: str) -> None:
        self.records = folder / "records"
        self.records.mkdir()
        self._log = Log(self.records, "faults")
        self._dice = random.Random(seed)
        self._turns = Counter[int]()
        self._disk = disk
        self.site = Site(networks, folder, _POLICY, private='["rosie", "dora"]')
        self._policy = folder / "kept.toml"
        self._policy.write_text(_POLICY)
        self._wire = Member(networks.host("between"), "wire", _WIRE, folder / "runtime", script=_HERE / "slow_wire.py")
        self._wire.ask(json.dumps({"connect": GATEWAY["public"].removeprefix("tls/")}))
        self.drivers = {robot: Driver(self.site, robot, mutant) for robot in _ROBOTS}
        tokens = folder / "tokens.toml"
        self._token = add_token(tokens, "anna")
        http = ["-m", "trade_gateway", "http", "--name", "hall", "--listen", _HALL, "--tokens", str(tokens), "--json"]
        self._hall = Kept(self.site, "right", "hall", f"tls/{_WIRE}", http)
        self.clients = {slot: self._client(slot) for slot in range(len(_KINDS))}
        self._eve, self._warden = self._alarmist("eve"), self._alarmist("warden")

    def _client(self, slot: int) -> tuple[str, Member]:
        self._turns[slot] += 1
        kind = _KINDS[slot]
        host = "right2" if kind == "planner" and slot % 2 == 0 else "right"
        name = f"{kind}{slot}-{self._turns[slot]}"
        member = self.site.launched(host, name, identity=f"{kind}{slot}", script=_SCRIPTS[kind], policy=self._policy)
        reported = {
            "slot": slot,
            "seed": self._dice.randrange(2**32),
            "folder": str(self.records),
            "connect": f"tls/{_WIRE}",
            "by": kind,
            "url": f"http://{_HALL}",
            "token": self._token,
        }
        member.tell(json.dumps(reported))
        return name, member

    def _alarmist(self, name: str) -> Member:
        """One without any role, or one that may clear e-stops."""
        member = self.site.launched("right2", name, script=_HERE / "alarmist.py", policy=self._policy)
        member.tell(json.dumps({"connect": GATEWAY["public"]}))
        return member

    def restart(self, slot: int) -> None:
        """Another client in its place, which locks and moves."""
        self.clients[slot][1].kill()
        self.clients[slot] = self._client(slot)

    def siege(self, seconds: float, fewest: int, kinds: Sequence[str]) -> None:
        """A few troubles at a time, until that time is over and every kind was had so often; all is undone then.

        A short one has more of them at once, and shorter rests.

        Args:
            seconds: that time.
            fewest: so often.
            kinds: of `TROUBLES`.
        """
        long = seconds >= _LONG_S
        at_once, rest_s = ((1, 1, 2), 6.0) if long else ((1, 2, 2), 4.0)
        done, until, bag = Counter[str](), time.monotonic() + seconds, list[str]()
        while time.monotonic() < until or min(done[kind] for kind in kinds) < fewest:
            undo: list[Callable[[], None]] = []
            now = set[str]()
            for _ in range(self._dice.choice(at_once)):
                if not bag:
                    bag = self._dice.sample(kinds, len(kinds))
                kind = bag.pop()
                if kind in now:  # a gateway that is killed twice would be started twice
                    continue
                now.add(kind)
                done[kind] += 1
                undo.append(TROUBLES[kind](self))
                self._rest(0.3)
            self._rest(self._dice.choice((0.5, 3.0, 8.0)))
            for back in reversed(undo):
                back()
            self._rest(rest_s)
            self._clear(_CLEARED_AGAIN_S)  # who was away when the others cleared keeps it open

    def _rest(self, most_s: float) -> None:
        threading.Event().wait(self._dice.random() * most_s)

    def _noted(self, what: str, whom: str, undo: Callable[[], object] | None) -> Callable[[], None]:
        """Note it as it begins and, if it ends, with that time instead."""
        began = time.monotonic()
        if undo is None:
            self._log.note(Fault(t=began, what=what, whom=whom, until=1e12))

        def back() -> None:
            if undo is not None:
                self._log.note(Fault(t=began, what=what, whom=whom, until=time.monotonic()))
                undo()

        return back

    def kill_client(self) -> Callable[[], None]:
        slot = self._dice.randrange(len(_KINDS))
        name, member = self.clients[slot]
        self._noted("kill client", name, None)
        member.kill()
        self.clients[slot] = self._client(slot)
        return _nothing

    def freeze_client(self) -> Callable[[], None]:
        name, member = self.clients[self._dice.randrange(len(_KINDS))]
        return self._noted("freeze client", name, _frozen(member.pid))

    def _driver(self) -> Driver:
        return self._dice.choice([*self.drivers.values()])

    def kill_driver(self) -> Callable[[], None]:
        driver = self._driver()
        self._noted("kill driver", driver.robot, None)
        _signal(driver.pid, signal.SIGKILL)
        return _nothing

    def freeze_driver(self) -> Callable[[], None]:
        driver = self._driver()
        return self._noted("freeze driver", driver.robot, _frozen(driver.pid))

    def unplug(self) -> Callable[[], None]:
        driver = self._driver()
        driver.sim.control.unplug()
        return self._noted("unplug", driver.robot, driver.sim.control.replug)

    def bus_off(self) -> Callable[[], None]:
        """The adapter of the CAN bus has seen too many errors: it neither hears nor says anything."""
        control = self.drivers["dora"].sim.control
        control.do(BusOff(bus=CAN_BUS))
        return self._noted("bus off", "dora", lambda: control.do(BusOff(bus=CAN_BUS, on=False)))

    def kill_gateway(self) -> Callable[[], None]:
        back = self._noted("kill gateway", "door", self.site.begin)  # it may be there again before anybody is missed
        self.site.end(signal.SIGKILL)
        return back

    def freeze_gateway(self) -> Callable[[], None]:
        return self._noted("freeze gateway", "door", _frozen(self.site.gateway.pid))

    def kill_http_gateway(self) -> Callable[[], None]:
        self._noted("kill http gateway", "hall", None)
        _signal(self._hall.pid, signal.SIGKILL)
        return _nothing

    def freeze_http_gateway(self) -> Callable[[], None]:
        return self._noted("freeze http gateway", "hall", _frozen(self._hall.pid))

    def cut(self) -> Callable[[], None]:
        """Both clients' hosts, or the robots'."""
        network, hosts = self._dice.choice([("net1", ("left",)), ("net2", ("right", "right2"))])
        switch = self.site.networks.host(f"{network}-switch")
        for host in hosts:
            ip("-n", switch, "link", "set", host, "down")

        def heal() -> None:
            for host in hosts:
                ip("-n", switch, "link", "set", host, "up")

        return self._noted("cut", network, heal)

    def one_way(self) -> Callable[[], None]:
        """What the robots' host says gets lost, what is said to it arrives; or what the gateway says to it."""
        host, other = self._dice.choice([("left", "10.231.1.1"), ("between", "10.231.1.2")])
        namespace = self.site.networks.host(host)
        with suppress(subprocess.CalledProcessError):  # there already, by the other trouble of this moment
            ip("-n", namespace, "route", "add", "blackhole", f"{other}/32")

        def heal() -> None:
            with suppress(subprocess.CalledProcessError):
                ip("-n", namespace, "route", "del", "blackhole", f"{other}/32")

        return self._noted("one way", host, heal)

    def delay(self) -> Callable[[], None]:
        """What clients send is held back, what they receive, or both."""
        most_s = self._dice.choice((0.5, 1.0, 1.5))
        up, down = self._dice.choice([(most_s, 0.0), (0.0, most_s), (most_s, most_s)])
        before = self._slow(up, down)

        def end() -> None:
            """Something is to be held back first, for a while: others may have had nothing to say."""
            until = time.monotonic() + _HELD_BACK_S
            while self._slow(up, down) <= before and time.monotonic() < until:
                self._rest(0.5)
            self._slow(0.0, 0.0)

        return self._noted("delay", "net2", end)

    def _slow(self, up: float, down: float) -> int:
        return self._wire.ask(json.dumps({"up": up, "down": down}))

    def policy(self) -> Callable[[], None]:
        """The gateway lets no client lock dora, for a while. Others read their policy once, and keep it."""
        self._write_policy(_POLICY.replace('lock = ["rosie", "dora"]', 'lock = ["rosie"]'))
        return self._noted("policy", "door", lambda: self._write_policy(_POLICY))

    def _write_policy(self, text: str) -> None:
        """Whole at once: a gateway that starts may read it at any moment."""
        fresh = self.site.policy.with_suffix(".new")
        fresh.write_text(text)
        fresh.replace(self.site.policy)

    def clock(self) -> Callable[[], None]:
        """The wall clock of a robot's driver jumps, and back."""
        driver = self._driver()
        wall_clock.shift(driver.clock, self._dice.choice(_JUMPS_S))
        return self._noted("clock", driver.robot, lambda: wall_clock.shift(driver.clock, 0.0))

    def disk(self) -> Callable[[], None]:
        """There is no room any more for what drivers, HTTP gateway and gateway keep."""
        self._disk.fill()
        return self._noted("disk", "all", self._disk.free)

    def strangers(self) -> Callable[[], None]:
        """They fill the gateway's ports, or a driver's; a client without a link has to stop something."""
        robot = self._dice.choice([*self.drivers])
        whom = self._dice.choice(["door", robot])
        host, per_s = ("right2" if whom == "door" else "left"), str(_STRANGERS)
        crowd = subprocess.Popen(
            [*self._on(host), str(_HERE / "stranger_flood.py"), self._ports(whom), per_s, per_s, "-", "-"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
        )

        def leave() -> None:
            crowd.kill()
            threading.Event().wait(_LEFT_S)

        back = self._noted("strangers", whom, leave)
        self._rest(2.0)
        self._log.note(self._rescue(whom, robot))

        def end() -> None:
            back()
            crowd.communicate()

        return end

    def estops(self) -> Callable[[], None]:
        """An identity without any role floods the system with e-stops; in the end all are cleared."""
        began = time.monotonic()
        back = self._noted("estops", "all", lambda: self._clear(_CLEARED_S))
        confirmed = self._eve.ask("flood", str(_ESTOPS))
        latched = time.monotonic()

        def end() -> None:
            for robot in {who.partition("/")[0] for who in confirmed} & {*self.drivers}:
                self._log.note(Alarm(t=latched, robot=robot, since=began, until=time.monotonic()))
            back()

        return end

    def _clear(self, limit_s: float) -> list[str]:
        return self._warden.ask("clear", str(limit_s))

    def _on(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.site.networks.host(host), sys.executable]

    def _ports(self, whom: str) -> str:
        if whom == "door":
            host, port = GATEWAY["public"].removeprefix("tls/").split(":")
            return f"{host}:{port},{host}:{int(port) + 1000}"
        there = (self.site.folder / "runtime" / whom / SYSTEM).glob("tls_*")  # none, if it has just been killed
        return ",".join(":".join(path.name.split("_")[1:]) for path in there) or "127.0.0.1:1"

    def _rescue(self, whom: str, robot: str) -> Rescue:
        """A program of the robot's own user, on its host; or one on the public network."""
        identity = robot if whom == robot else "anna"
        settings = {
            "TRADE_SYSTEM": SYSTEM,
            "TRADE_TLS": str(self.site.papers.of(identity)),
            "TRADE_POLICY": str(self._policy),
            "TRADE_RUNTIME_DIR": str(self.site.folder / "runtime" / identity),
        }
        began = time.monotonic()
        words = [str(_HERE / "rescuer.py"), robot, str(_RESCUE_S), *([] if whom == robot else [GATEWAY["public"]])]
        said = subprocess.run(
            [*self._on("left" if whom == robot else "right"), *words],
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        reported = json.loads(said.stdout) if said.returncode == 0 else {"through": False, "said": said.stderr}
        return Rescue(t=began, whom=whom, until=time.monotonic(), through=reported["through"], said=reported["said"])

    def quiet(self) -> None:
        """No client holds a lock any more, and no e-stop is open."""
        for _, member in self.clients.values():
            member.tell("quiet")
        for _, member in self.clients.values():
            member.heard()
        still_open = self._clear(_CLEARED_S)
        assert not still_open, still_open

    def wrong(self) -> dict[str, list[str]]:
        """By client, what does not work although there is no trouble any more."""
        return {name: member.ask("works") for name, member in self.clients.values()}

    def held_back(self) -> int:
        """How often the connection of the clients has held something back."""
        return self._slow(0.0, 0.0)

    def held(self) -> dict[str, tuple[int, int]]:
        """By serving process of this project: its open files and its threads."""
        pids = {"gateway": self.site.gateway.pid, "door": self._hall.pid}
        pids |= {name: driver.pid for name, driver in self.drivers.items()}
        processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        return {name: (process.num_fds(), process.num_threads()) for name, process in processes.items()}

    def close(self) -> None:
        for kept in (*self.drivers.values(), self._hall):
            with suppress(AssertionError):  # it has not begun yet
                _signal(kept.pid, signal.SIGCONT)
            kept.close()
        _signal(self.site.gateway.pid, signal.SIGCONT)
        self._wire.close()
        self.site.close()
        self._log.close()


TROUBLES: Final[Mapping[str, Callable[[Stand], Callable[[], None]]]] = {
    "kill client": Stand.kill_client,
    "freeze client": Stand.freeze_client,
    "kill driver": Stand.kill_driver,
    "freeze driver": Stand.freeze_driver,
    "unplug": Stand.unplug,
    "bus off": Stand.bus_off,
    "kill gateway": Stand.kill_gateway,
    "freeze gateway": Stand.freeze_gateway,
    "kill http gateway": Stand.kill_http_gateway,
    "freeze http gateway": Stand.freeze_http_gateway,
    "cut": Stand.cut,
    "one way": Stand.one_way,
    "delay": Stand.delay,
    "policy": Stand.policy,
    "clock": Stand.clock,
    "disk": Stand.disk,
    "strangers": Stand.strangers,
    "estops": Stand.estops,
}
"""Each begins, and returns what ends it."""


def _frozen(pid: int) -> Callable[[], None]:
    """Stop a process for now; returns what has it go on."""
    _signal(pid, signal.SIGSTOP)
    return lambda: _signal(pid, signal.SIGCONT)


def _signal(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):  # it may have been killed meanwhile
        os.kill(pid, number)


def _nothing() -> None: ...


@contextmanager
def stand(networks: Networks, folder: Path, seed: int, mutant: str = "") -> Generator[Stand]:
    """All of it, ended after use; ``mutant``: how its drivers are broken, see `broken_driver`."""
    disk = Disk(folder / "disk")
    settings = {
        "PYTHONPATH": str(_HERE.parents[1]),
        "TRADE_STATE_DIR": str(folder / "disk" / "gateway"),
    }
    try:
        with mock.patch.dict(os.environ, settings):
            made = Stand(networks, folder, disk, seed, mutant)
            try:
                yield made
            finally:
                made.close()
    finally:
        disk.close()
