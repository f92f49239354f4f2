"""A container on a network of its own: takes commands on standard input, answers with a line each."""

import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from trade import Container, Handle, HookEvent, Lock, Resource, Run, Settings, Stream, current_call, service, where
from trade.protocol.samples import stream_key
from trade.transport.zenoh_links import _others

PROVIDERS = 5


class Echo:
    @service(effect="read")
    def echo(self, value: int) -> int:
        return value

    def __init__(self) -> None:
        self.moves: list[int] = []

    @service(serial=True)
    def move(self, number: int) -> None:
        self.moves.append(number)

    @service(effect="read")
    def nap(self, seconds: float) -> None:
        threading.Event().wait(seconds)


class Joint(Echo):
    """Something that is locked, stopped and resumed."""

    def __init__(self) -> None:
        super().__init__()
        self.resources = (Resource("joint"),)
        self.greeted: list[str] = []

    @service(effect="stop")
    def halt(self) -> None: ...

    @service
    def greet(self, newcomer: Handle) -> None:
        """Noted with who calls."""
        call = current_call()
        assert call is not None
        self.greeted.append(f"{call.caller} {newcomer.label}")


class Ticker:
    @service(effect="read")
    def asked(self) -> int:
        """How often."""
        self._asked += 1
        return self._asked

    def __init__(self) -> None:
        self._asked = 0


class Watch:
    """Records the arguments of the calls that it is notified of."""

    def __init__(self) -> None:
        self.noted: list[Any] = []

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.noted.append(called.args)


class Relay:
    """Moves something of others for any caller."""

    def __init__(self, container: Container, of: str) -> None:
        self._container = container
        self._of = of

    @service
    def relay(self, number: int) -> None:
        self._container.find(where(name="move", group=self._of))(number)


class Member:
    def __init__(self, name: str, address: str) -> None:
        self.name = name
        self.address = address
        self.container: Container | None = None
        self._gone: list[str] = []
        self._kept: Handle | None = None
        self._run: Run | None = None
        self._lock: Lock | None = None
        self._providers: dict[str, Echo] = {}
        self._tapped: list[Any] = []
        self._stream: Stream | None = None

    @property
    def up(self) -> Container:
        assert self.container is not None
        return self.container

    def start(self, *connect: str, turn: str = "0") -> str:
        system = f"{os.environ['TRADE_SYSTEM']}-{turn}"
        protocol = "tls" if "TRADE_TLS" in os.environ else "tcp"
        listen = [f"{protocol}/{address}" for address in self.address.split(",") if address]
        self.container = Container(
            Settings.read(system=system, container=self.name, listen=listen, connect=connect or None)
        )
        return self.container.reach._links._main_endpoint()

    def reopen(self, *connect: str) -> None:
        """Close its container, and start the next one of the same name, as a gateway does for another policy."""
        self.up.close()
        self.start(*connect)

    def find_each_other(self) -> None:
        self.up.system.set_broadcast(True)
        self.up.system.set_discovery(True)

    def register_one(self, group: str) -> None:
        self._providers[group] = Echo()
        self.up.register(self._providers[group], group)

    def deregister_one(self, group: str) -> None:
        self.up.deregister(self._providers.pop(group))

    def register_joint(self, group: str) -> None:
        self._providers[group] = Joint()
        self.up.register(self._providers[group], group)

    def register_relay(self, group: str, of: str) -> None:
        self.up.register(Relay(self.up, of), group)

    def add_group(self, of: str, group: str) -> None:
        self.up.add_group(self._providers[of], group)

    def remove_group(self, of: str, group: str) -> None:
        self.up.remove_group(self._providers[of], group)

    def group(self, group: str, *expected: str) -> list[list[str]]:
        """Host and label of the group's echo services once their containers are as expected, or after half a minute."""
        wanted = where(group=group, name="echo")
        there = lambda: sorted(handle.container for handle in self.up.services(wanted))  # noqa: E731
        self.up._parts.registry.wait_for(lambda: there() == sorted(expected), 30)
        return [[handle.host, handle.label] for handle in self.up.services(wanted)]

    def call_group(self, group: str) -> list[int]:
        return [outcome.result for outcome in self.up.call_all(where(group=group, name="echo"), 7)]

    def lock(self, group: str) -> list[str]:
        """Hold all that moves there, and move it."""
        with self.up.lock(where(group=group)) as lock:
            self.up.find(where(name="move", group=group))(1)
            return list(lock.resources)

    def hold(self, group: str) -> None:
        """Take a lock and keep it."""
        self._lock = self.up.lock(where(group=group)).acquire()

    def hold_when_there(self, group: str) -> None:
        """The same once something that moves exists."""
        self.up.find(where(name="move_to", group=group), wait_s=30)
        self.hold(group)

    def held(self) -> bool:
        """Whether it still holds, for those who granted it, too."""
        assert self._lock is not None
        with self._lock.use():
            self.up.find(where(name="move", group="rosie.arm.p0"))(1)
        return self._lock.held

    def try_move(self, of: str, deadline_s: str) -> None:
        """Move what it has seen before, or sees now, however long that takes."""
        handles = self.up.services(where(name="move", group=of))
        self._kept = handles[0] if handles else self._kept
        assert self._kept is not None
        self._kept.with_(deadline_s=float(deadline_s))(1)

    def watch(self) -> None:
        """From now on note which containers' services leave."""
        self.up.left(where(name="echo"), lambda handle: self._gone.append(handle.container))

    def gone(self) -> list[str]:
        return self._gone

    def keep(self, container: str) -> None:
        """Hold on to a service of that container."""
        self._kept = self.up.find(where(name="echo", group=f"{container}.p0"))

    def use(self) -> int:
        assert self._kept is not None
        return self._kept(3)

    def nap(self, container: str) -> None:
        """Begin a call of a service of that container that takes five seconds."""
        self._run = self.up.find(where(name="nap", group=f"{container}.p0")).with_(deadline_s=60).start(5.0)

    def woken(self) -> None:
        assert self._run is not None
        self._run.result()

    def linked(self, count: str) -> list[str]:
        """Ids of whom it is linked to once they are so many; whichever they are after half a minute."""
        until = time.monotonic() + 30
        while len(found := _others(self._session)) != int(count) and time.monotonic() < until:
            threading.Event().wait(0.02)
        return sorted(found)

    def id(self) -> str:
        return str(self._session.zid())

    @property
    def _session(self) -> Any:
        return self.up.reach._links._session

    def register(self) -> None:
        for number in range(PROVIDERS):
            self.up.register(Echo(), f"{self.name}.p{number}")

    def join_and_register(self, turn: str) -> None:
        self.start(turn=turn)
        self.find_each_other()
        self.register()

    def connect(self, endpoint: str) -> None:
        self.up.system.connect(endpoint)

    def sees(self, count: str) -> list[str]:
        """The echo services once there are so many; whatever there is after half a minute."""
        wanted = where(name="echo")
        self.up._parts.registry.wait_for(lambda: len(self.up.services(wanted)) == int(count), 30)
        return [handle.label for handle in self.up.services(wanted)]

    def call_all(self) -> int:
        handles = self.up.services(where(name="echo"))
        return sum(handle(number) == number for number, handle in enumerate(handles))

    def move(self, of: str, times: str) -> None:
        move = self.up.find(where(name="move", group=of))
        for number in range(int(times)):
            move(number)

    def moved(self, of: str) -> list[int]:
        return self._providers[of].moves

    def greeted(self, of: str) -> list[str]:
        joint = self._providers[of]
        assert isinstance(joint, Joint)
        return joint.greeted

    def greet_joining(self, group: str, of: str) -> None:
        """From now on a joint greets, in our name, whatever of the group joins."""
        self.up.joined(where(name="echo", group=group), self.up.find(where(name="greet", group=of)))

    def watch_moves(self, group: str, mine: str) -> None:
        """From now on note, in a service of this container's group, what moves there."""
        self._watch = Watch()
        [see] = self.up.register(self._watch, mine)
        self._hook = self.up.after_service(self.up.find(where(name="move", group=group)), see)

    def seen_moving(self) -> list[Any]:
        return self._watch.noted

    def watch_no_more(self) -> None:
        self._hook.detach()

    def once_at(self, host: str, name: str, group: str, *arguments: str) -> Any:
        """Have another container make a call; how that went."""
        call = self.up.find(where(name=name, group=group)).bind(*map(json.loads, arguments))
        asked = self.up.every(0.02, call, host=host)
        while not (info := asked.info()).fired and not info.failures:
            time.sleep(0.01)
        asked.cancel()
        return info.last_error or "done"

    def call(self, name: str, group: str, container: str, *arguments: str) -> Any:
        """Call a service of that container; the arguments are JSON."""
        wanted = where(name=name, group=group, container=container)
        return self.up.call(wanted, *map(json.loads, arguments))

    def started(self, name: str, group: str, *arguments: str) -> None:
        """Begin a call, under the lock if there is one."""
        with self._lock.use() if self._lock is not None else contextlib.nullcontext():
            found = self.up.find(where(name=name, group=group)).with_(deadline_s=120)
            self._run = found.start(*map(json.loads, arguments))

    def ended(self) -> Any:
        """What came of the call that was begun."""
        assert self._run is not None
        return self._run.result(60)

    def still_held(self) -> bool:
        assert self._lock is not None
        return self._lock.held

    def unlock(self) -> None:
        assert self._lock is not None
        self._lock.release()
        self._lock = None

    def grants(self) -> list[list[Any]]:
        """What shows the lock to those that granted it."""
        assert self._lock is not None
        return [[token.epoch, token.number] for token in self._lock.tokens()]

    def break_lock(self, group: str) -> None:
        self.up.break_lock(where(group=group), "it is needed")

    def resume(self, group: str) -> None:
        self.up.resume(where(group=group))

    def estop(self) -> str:
        return self.up.estop("a test").id

    def estop_clear(self, estop: str) -> bool:
        return self.up.estop_clear([estop], limit_s=1.0).complete

    def estops(self) -> list[str]:
        return [known.id for known in self.up.estops()]

    def load_policy(self, path: str) -> None:
        self.up.load_policy(path)

    def session(self) -> str:
        return self.up.session

    def place(self, name: str, group: str) -> list[str]:
        """Identity, container, epoch, domain and provider of a service."""
        key = self.up.find(where(name=name, group=group)).key
        return [*str(key.address).split("/"), key.domain, key.provider]

    def waits(self) -> list[Any]:
        """Of the call that was begun: the reply channel, and its number."""
        caller = self.up._parts.caller
        [number] = caller._pending
        assert caller._shared is not None
        return [caller._shared.name, number]

    def seen(self, group: str) -> list[str]:
        """Who offers something there, as far as is known now."""
        return sorted(str(handle.key.address) for handle in self.up.services(where(name="echo", group=group)))

    def addresses(self) -> list[str]:
        return [str(address) for address in self.up.addresses()]

    def attempts(self) -> list[str]:
        """What came of the addresses that were tried."""
        return [str(attempt) for attempt in self.up.reach.attempts()]

    def tap(self) -> None:
        """From now on note all that the transport hands to this container."""
        fifo = zenoh.handlers.FifoChannel(8192)
        who = self.up.address.identity
        patterns = [f"call/*/{who}/**", f"stop/*/{who}/**", f"reply/*/{who}/**", "registry/**", "estop/**"]
        self._tapped = [self._session.declare_subscriber(pattern, fifo) for pattern in patterns]

    def tapped(self) -> list[str]:
        """The keys of what was heard since it was asked last."""
        heard = [iter(tap.handler.try_recv, None) for tap in self._tapped]
        return [str(sample.key_expr) for samples in heard for sample in samples]

    def state(self) -> dict[str, Any]:
        """For the message of a test that failed."""
        links = self.up.reach._links
        return {
            "own": links._own[:6],
            "peers": [str(peer)[:6] for peer in links._session.info.peers_zid()],
            "containers": {str(s.address): s.heard.complete for s in self.up._parts.registry.containers()},
            "refused": self.up.reach._refused,
            "attempts": self.attempts(),
        }

    def register_ticker(self, group: str) -> None:
        self.up.register(Ticker(), group)

    def listen(self, group: str, hz: str) -> None:
        self._stream = self.up.stream(where(name="asked", group=group), hz=float(hz), keep=10_000)

    def rate(self) -> float:
        """Of the stream that is listened to."""
        assert self._stream is not None
        return self._stream.hz

    def skip(self) -> None:
        """What has come by now."""
        assert self._stream is not None
        while self._stream.take() is not None:
            pass

    def heard(self, count: str) -> list[list[int]]:
        """Value, number and dropped of so many samples."""
        assert self._stream is not None
        samples = [self._stream.next(30) for _ in range(int(count))]
        return [[sample.value, sample.number, sample.dropped] for sample in samples]

    def overhear(self, group: str, hz: str) -> None:
        """Receive samples at a rate that no client here asked for."""
        key = self.up.find(where(name="asked", group=group)).key
        self._tapped = [self._session.declare_subscriber(stream_key(key, float(hz)), zenoh.handlers.FifoChannel(8192))]

    def stop(self) -> None:
        self.up.close()


def main(host: str, name: str, address: str) -> None:
    socket.sethostname(host)
    member = Member(name, address)
    for line in sys.stdin:
        verb, *words = line.split()
        action: Callable[..., Any] = getattr(member, verb)
        try:
            answer: Any = {"answer": action(*words)}
        except Exception as error:  # noqa: BLE001 - whatever it was is reported to the test
            answer = {"error": f"{type(error).__name__}: {error}"}
        os.write(1, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
