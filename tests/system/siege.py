"""The siege: two simulated robots on one host, a gateway on another, planners on two more, and all their troubles."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final
from unittest import mock

import psutil
from tests.holds import Log

from system.networks import Member, Networks, ip
from system.siege_records import Fault
from system.sites import DOOR, SYSTEM, Site
from trade_hil_sim import SimProcess

_SCRIPT: Final = Path(__file__).with_name("planner.py")
_BROKEN: Final = Path(__file__).with_name("broken_driver.py")
_PLANNERS: Final = 4
_POLICY: Final = f"""
gateways = ["door"]

[roles.driver]
register = ["rosie", "dora"]

[roles.operator]
read = ["*"]
call = ["rosie", "dora"]
lock = ["rosie", "dora"]

[identities]
rosie = ["driver"]
dora = ["driver"]
{"".join(f'planner{slot} = ["operator"]' + chr(10) for slot in range(_PLANNERS))}"""
_JOINT: Final = """
[joint."{name}"]
bus = "{bus}"
id = {id}
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
_ROBOTS: Final = {"rosie": ("neck", ("pan", "tilt")), "dora": ("arm", ("elbow", "wrist"))}


def _robot_file(robot: str) -> str:
    bus, joints = _ROBOTS[robot]
    return f'[robot]\nname = "{robot}"\n\n[bus.{bus}]\ndriver = "dynamixel"\nport = "/dev/ttyNOWHERE"\n' + "".join(
        _JOINT.format(name=f"{bus}.{joint}", bus=bus, id=number) for number, joint in enumerate(joints, 1)
    )


class Driver:
    """A robot's simulated servos, and beside them its driver, which may be killed and started again."""

    def __init__(self, site: Site, robot: str, mutant: str = "") -> None:
        self.robot = robot
        self.program = [str(_BROKEN), mutant] if mutant else ["-m", "trade_gateway"]
        """What is run when it is started the next time."""
        self._site = site
        file = site.folder / f"{robot}.toml"
        file.write_text(_robot_file(robot))
        self.sim = SimProcess(file)
        text = file.read_text()
        for port in self.sim.ports.values():
            text = text.replace("/dev/ttyNOWHERE", port)
        file.write_text(text)
        self._file = file
        self._complaints = (site.folder / f"{robot}.complaints").open("ab")
        self._papers = site.papers.of(robot)
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
        """Start it whenever it does not run: it is killed, and ends by itself while its bus is unplugged."""
        while not self._closed.wait(0.5):
            if self._process is None or self._process.poll() is not None:
                self._begin()

    def _begin(self) -> None:
        settings = {
            "TRADE_SYSTEM": SYSTEM,
            "TRADE_TLS": str(self._papers),
            "TRADE_POLICY": str(self._site.folder / "kept.toml"),
            "TRADE_CONNECT": DOOR["private"],
            "TRADE_RUNTIME_DIR": str(self._site.folder / "runtime" / "left"),
            "TRADE_STATE_DIR": str(self._site.folder / "state" / "left"),
        }
        self._process = subprocess.Popen(
            [
                *("ip", "netns", "exec", self._site.networks.host("left")),
                *(sys.executable, *self.program, "up", str(self._file), "--json"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=self._complaints,
            env={**os.environ, **settings},
        )

    def close(self) -> None:
        self._closed.set()
        self._keeper.join()
        if self._process is not None:
            self._process.kill()
            self._process.wait(20)
        self.sim.close()
        self._complaints.close()


class Stand:
    """All of it. Troubles come from one seed; each is noted with how long it lasted."""

    def __init__(self, networks: Networks, folder: Path, seed: int, mutant: str) -> None:
        self.records = folder / "records"
        self.records.mkdir()
        self._log = Log(self.records, "faults")
        self._dice = random.Random(seed)
        self._turns = Counter[int]()
        self.site = Site(networks, folder, _POLICY, private='["rosie", "dora"]')
        self._policy = folder / "kept.toml"
        self._policy.write_text(_POLICY)
        self.drivers = {robot: Driver(self.site, robot, mutant) for robot in _ROBOTS}
        self.planners = {slot: self._planner(slot) for slot in range(_PLANNERS)}

    def _planner(self, slot: int) -> tuple[str, Member]:
        self._turns[slot] += 1
        host = "right" if slot % 2 else "right2"
        name = f"planner{slot}-{self._turns[slot]}"
        member = self.site.launched(host, name, identity=f"planner{slot}", script=_SCRIPT, policy=self._policy)
        told = {
            "slot": slot,
            "seed": self._dice.randrange(2**32),
            "folder": str(self.records),
            "connect": DOOR["public"],
        }
        member.tell(json.dumps(told))
        return name, member

    def restart(self, slot: int) -> None:
        """Another planner in its place, which locks and moves."""
        self.planners[slot][1].kill()
        self.planners[slot] = self._planner(slot)

    # --- troubles

    def siege(self, seconds: float, fewest: int) -> None:
        """One trouble or two at a time, until that time is over and every kind was had so often; all is undone then."""
        kinds = [self.kill_planner, self.freeze_planner, self.kill_driver, self.freeze_driver, self.unplug]
        kinds += [self.kill_gateway, self.freeze_gateway, self.cut, self.one_way, self.change_policy]
        done, until, bag = Counter[str](), time.monotonic() + seconds, list[Callable[[], Callable[[], None]]]()
        while time.monotonic() < until or min(done[kind.__name__] for kind in kinds) < fewest:
            undo: list[Callable[[], None]] = []
            for _ in range(self._dice.choice((1, 1, 2))):
                if not bag:
                    bag = self._dice.sample(kinds, len(kinds))
                kind = bag.pop()
                done[kind.__name__] += 1
                undo.append(kind())
                self._rest(0.3)
            self._rest(self._dice.choice((0.5, 3.0, 8.0)))
            for back in reversed(undo):
                back()
            self._rest(6.0)

    def _rest(self, most_s: float) -> None:
        threading.Event().wait(self._dice.random() * most_s)

    def _noted(self, what: str, whom: str, undo: Callable[[], None] | None) -> Callable[[], None]:
        """Note it as it begins and, if it ends, with that time instead."""
        began = time.monotonic()
        if undo is None:
            self._log.note(Fault(t=began, what=what, whom=whom, until=1e12))

        def back() -> None:
            if undo is not None:
                self._log.note(Fault(t=began, what=what, whom=whom, until=time.monotonic()))
                undo()

        return back

    def kill_planner(self) -> Callable[[], None]:
        slot = self._dice.randrange(_PLANNERS)
        name, member = self.planners[slot]
        self._noted("kill planner", name, None)
        member.kill()
        self.planners[slot] = self._planner(slot)
        return _nothing

    def freeze_planner(self) -> Callable[[], None]:
        name, member = self.planners[self._dice.randrange(_PLANNERS)]
        return self._noted("freeze planner", name, _frozen(member.pid))

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

    def kill_gateway(self) -> Callable[[], None]:
        self._noted("kill gateway", "door", None)
        self.site.end(signal.SIGKILL)
        return self.site.begin

    def freeze_gateway(self) -> Callable[[], None]:
        return self._noted("freeze gateway", "door", _frozen(self.site.gateway.pid))

    def cut(self) -> Callable[[], None]:
        """Both planners' hosts, or the robots'."""
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

    def change_policy(self) -> Callable[[], None]:
        """The gateway lets nobody lock dora, for a while. Others read their policy once, and keep it."""

        def back() -> None:
            self.site.policy.write_text(_POLICY)

        self.site.policy.write_text(_POLICY.replace('lock = ["rosie", "dora"]', 'lock = ["rosie"]'))
        return self._noted("policy", "door", back)

    # --- after it

    def quiet(self) -> None:
        """Everybody locks nothing any more."""
        for _, member in self.planners.values():
            member.tell("quiet")
        for _, member in self.planners.values():
            member.heard()

    def wrong(self) -> dict[str, list[str]]:
        """By planner, what does not work although there is no trouble any more."""
        return {name: member.ask("works") for name, member in self.planners.values()}

    def held(self) -> dict[str, tuple[int, int]]:
        """By process of ours that serves: its open files and its threads."""
        pids = {"door": self.site.gateway.pid, **{name: driver.pid for name, driver in self.drivers.items()}}
        processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        return {name: (process.num_fds(), process.num_threads()) for name, process in processes.items()}

    def close(self) -> None:
        for driver in self.drivers.values():
            _signal(driver.pid, signal.SIGCONT)
            driver.close()
        _signal(self.site.gateway.pid, signal.SIGCONT)
        self.site.close()
        self._log.close()


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
    with mock.patch.dict(os.environ, PYTHONPATH=os.pathsep.join(map(str, _SCRIPT.parents[1:3]))):
        made = Stand(networks, folder, seed, mutant)
        try:
            yield made
        finally:
            made.close()
