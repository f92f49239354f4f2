"""A whole system in one process: a death at any message lets no other hang; after a storm all know the same."""

import concurrent.futures
import random
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from tests.unit.trade.lamp_provider import Lamp, Pair, found, labels
from trade import Container, where
from trade.errors import ConfigurationError, ContainerLost, NoSuchService, ServiceGone, TradeError
from trade.testing import MemorySystem, memory_system
from trade.transport.base import ChannelClosed
from trade.transport.memory import InFlightMessage

pytestmark = pytest.mark.virtual_time


class Death:
    """Kills a container at one message of many: before it is sent, or when it has just arrived."""

    def __init__(self, system: MemorySystem, victim: str, step: int | None) -> None:
        self.count = 0
        self.at: InFlightMessage | None = None
        self._system = system
        self._victim = victim
        self._step = step
        system.tap(self._hear)

    def _hear(self, passage: InFlightMessage) -> None:
        if self.count == self._step:
            self.at = passage
            self._system.kill(self._victim)
        self.count += 1

    @property
    def happened(self) -> bool:
        return self.at is not None


def meet_offer_and_call(system: MemorySystem, death: Death) -> list[BaseException]:
    """A callee joins, offers, is called twice, withdraws, leaves. Returns the caller's errors."""
    caller, errors, offered = system.container("caller"), list[BaseException](), Lamp()
    callee: Container | None = None

    def of_callee(action: Callable[[], object]) -> None:
        try:
            action()
        except (ChannelClosed, TradeError):
            assert death.happened

    def join() -> None:
        nonlocal callee
        callee = system.container("callee")

    of_callee(join)
    system.settle()  # each has asked the other
    if callee is not None:
        joined: Container = callee
        of_callee(lambda: joined.register(offered, "robot"))
    try:
        handle = caller.find(where(name="dim", group="robot"), wait_s=0 if death.happened else 20)
        for value in (0.1, 0.2):
            assert handle.with_(deadline_s=60)(value) == value
    except TradeError as error:
        errors.append(error)
    if callee is not None:
        of_callee(lambda: joined.deregister(offered))
        joined.close()
    return errors


def steps() -> int:
    with memory_system() as system:
        system.container("caller")
        death = Death(system, "", None)
        assert meet_offer_and_call(system, death) == []
        return death.count


@pytest.mark.parametrize("victim", ["caller", "callee"])
def test_a_death_at_any_message_hangs_no_client_and_the_rest_continues(
    victim: str,
) -> None:
    total = steps()
    own = ConfigurationError if victim == "caller" else NoSuchService  # a closed container says so to its own program
    assert total > 30
    for step in range(total):
        with memory_system() as system:
            system.container("caller")
            death = Death(system, victim, step)
            errors = meet_offer_and_call(system, death)
            assert death.at is not None
            for error in errors:
                assert isinstance(error, NoSuchService | ServiceGone | ContainerLost | own), (step, death.at, error)
            survivor = system.container("caller")
            system.settle()
            assert labels(survivor) == [], (step, death.at)
            system.container("callee").register(Lamp(), "again")
            assert found(survivor, "again")(0.9) == 0.9
            expected = ["caller", "callee"]
            assert sorted(info.name for info in survivor.containers()) == sorted(expected), (step, death.at)


@pytest.mark.parametrize("arrived", [False, True])
@pytest.mark.parametrize("answering", [False, True])
def test_the_death_of_a_callee_around_a_call_or_its_answer_is_reported_as_lost(
    pair: Pair, arrived: bool, answering: bool
) -> None:
    with memory_system() as system:
        _, _, handle = pair(system)
        kind = "reply/" if answering else "call/"

        def kill(passage: InFlightMessage) -> None:
            if passage.key.startswith(kind) and passage.arrived is arrived:
                system.kill("callee")

        system.tap(kill)
        if answering and arrived:
            with suppress(ContainerLost):  # the loss may overtake an answer that was not read yet
                assert handle(0.1) == 0.1
        else:
            with pytest.raises(ContainerLost):
                handle(0.1)


def test_callers_that_wait_are_all_freed_when_their_callee_dies(gate: Any) -> None:
    with memory_system() as system:
        callee, callers = system.container("callee"), [system.container(f"caller-{number}") for number in range(3)]
        callee.register(gate, "gate")
        handles = [caller.find(where(name="pass_through"), wait_s=20).with_(deadline_s=3600) for caller in callers]
        with concurrent.futures.ThreadPoolExecutor() as pool:
            blocked = [pool.submit(handle) for handle in handles]
            runs = [handle.start() for handle in handles]
            assert gate.entered.wait(20)
            system.kill(callee)
            errors = [waiting.exception(20) for waiting in (*blocked, *runs)]
        assert all(isinstance(error, ContainerLost | ServiceGone) for error in errors)
        gate.open.set()


def test_a_fault_of_a_container_that_was_never_started_is_an_error() -> None:
    with memory_system() as system, pytest.raises(LookupError, match="no container 'ghost' was started"):
        system.kill("ghost")


class Storm:
    """Containers that register, deregister, die and return while links break and return, all drawn from one seed."""

    def __init__(self, system: MemorySystem, seed: int, *, faults: bool) -> None:
        self._system = system
        self._random = random.Random(seed)
        self._names = ["a", "b", "c", "d"]
        self._offered: dict[str, list[Lamp]] = {name: [] for name in self._names}
        for name in self._names:
            system.container(name)
        self._acts = [self._offer] * 5 + [self._withdraw] * 3 + [self._wait] * 3
        self._acts += [self._cut, self._cut, self._reconnect, self._die] if faults else []
        system.delay(0.001, jitter_s=0.05)

    def rage(self, turns: int) -> None:
        for _ in range(turns):
            self._random.choice(self._acts)()
        self._system.heal()
        self._system.settle()

    def _any(self) -> str:
        return self._random.choice(self._names)

    def _offer(self) -> None:
        name, lamp = self._any(), Lamp()
        self._system.container(name).register(lamp, f"robot-{self._random.randrange(5)}")
        self._offered[name].append(lamp)

    def _withdraw(self) -> None:
        name = self._any()
        if self._offered[name]:
            lamp = self._offered[name].pop(self._random.randrange(len(self._offered[name])))
            self._system.container(name).deregister(lamp)

    def _wait(self) -> None:
        self._system.advance(self._random.choice([0.01, 0.1, 1, 2.5]))

    def _cut(self) -> None:
        one, other = self._random.sample(self._names, 2)
        self._system.partition(one, other, one_way=self._random.random() < 0.3)

    def _reconnect(self) -> None:
        self._system.heal(self._any())

    def _die(self) -> None:
        name = self._any()
        self._system.kill(name)
        self._offered[name].clear()
        self._system.container(name)

    def over(self) -> bool:
        """Whether all know exactly what each one offers now."""
        containers = [self._system.container(name) for name in self._names]
        truth = {handle.key for container in containers for handle in container.services(where.local)}
        return all({handle.key for handle in container.services()} == truth for container in containers)

    def count(self) -> int:
        return sum(len(lamps) for lamps in self._offered.values())


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("faults", [False, True], ids=["registrations", "partitions and deaths"])
def test_all_registries_are_the_same_after_a_storm(seed: int, faults: bool) -> None:
    with memory_system(seed=seed) as system:
        storm = Storm(system, seed, faults=faults)
        storm.rage(80 if faults else 60)
        assert storm.over()
        assert len(labels(system.container("a"))) == storm.count()
