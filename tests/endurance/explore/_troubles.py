"""What disturbs a story: orders of an operator, deaths, cuts and delays of the network, faults of devices."""

import random
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from tests.endurance.explore._gateway import DOOR
from tests.endurance.explore._records import Stopped
from tests.endurance.explore._robots import RobotKind
from tests.endurance.explore._stage import CLIENTS, Cast, Stage
from trade import EstopReport, StopReport, errors, where
from trade_hil_sim import Absent, BadCrc, BrownOut, BusOff, Emergency, Jam, Late, Mute, Replug, Unplug
from trade_hil_sim.damiao import DamiaoBus

__all__ = ["TROUBLES", "Trouble"]

_STALL: Final = 0.0005
_HOLDS_S: Final = 1.0
_PROMPT_S: Final = 1.0
_HARMLESS: Final = frozenset({"stop", "estop", "break lock", "kill", "clock step"})
"""Troubles after which links and devices are sound."""
_TRIES: Final = 20
_BRAKES_S: Final = 0.25
"""A joint whose lock was broken has got its stop by then, and rests."""


@dataclass(frozen=True)
class Trouble:
    """Something that happens, at a robot or at all."""

    do: Callable[[Stage, RobotKind], None]
    needs: Callable[[Cast, RobotKind], bool] = lambda _, __: True


# --- orders of an operator


def _stop(stage: Stage, kind: RobotKind) -> None:
    asked = stage.disturb()
    report = stage.operator.stop(kind.group)
    since = time.monotonic()
    _prompt(stage, f"stop of {kind.group}", report, since - asked)
    if not report.complete:
        return  # the report says what was not stopped
    stage.clock.sleep(_HOLDS_S)
    mine = [one for one in stage.moved if one.group == kind.group]
    if any(one.how == "Stopped" and one.since < asked < one.until for one in mine):
        stage.stopped.append(Stopped("stop", kind.group, since, time.monotonic()))  # it ended a motion, so it holds
    with suppress(errors.TradeError):
        stage.operator.resume(where(group=kind.group))


def _estop(stage: Stage, _: RobotKind) -> None:
    asked = stage.disturb()
    report = stage.operator.estop("drawn")
    since = time.monotonic()
    _prompt(stage, "e-stop", report, since - asked)
    stage.clock.sleep(_HOLDS_S)
    for kind in stage.cast.robots if report.complete else ():
        stage.stopped.append(Stopped("e-stop", kind.group, since, time.monotonic()))
    for name in ("judge", "planner"):  # it is cleared in each system
        with suppress(errors.NoSuchEstop):
            stage.client(name).estop_clear([report.id])


def _prompt(stage: Stage, what: str, report: StopReport | EstopReport, took_s: float) -> None:
    """Rule S07: where links and devices are sound, a stop is done in a second."""
    if stage.past <= _HARMLESS and not (report.complete and took_s <= _PROMPT_S):
        stage.outcome.violations.append(f"the {what} took {took_s:.3f} s, and reports {report}")


def _break(stage: Stage, kind: RobotKind) -> None:
    asked = stage.disturb()
    try:
        broken = stage.operator.break_lock(where(group=kind.group), reason="drawn")
    except errors.TradeError:
        return
    if not broken:
        return  # no client had it, or one on the other side of the gateway, whose locks it does not break
    since = time.monotonic()
    stage.stopped.append(Stopped("broken lock", kind.group, since, since + _HOLDS_S, _BRAKES_S, asked))


# --- deaths, cuts and delays


def _kill(stage: Stage, _: RobotKind) -> None:
    stage.disturb()
    name = stage.drawn.choice(CLIENTS)
    stage.system_of(name).kill(name)


def _kill_gateway(stage: Stage, _: RobotKind) -> None:
    stage.disturb()
    assert stage.gateway is not None
    stage.gateway.kill()
    stage.clock.sleep(stage.drawn.uniform(0.1, 3.0))
    stage.gateway.start()


def _restart_driver(stage: Stage, kind: RobotKind) -> None:
    stage.disturb()
    stage.detach(kind)
    stage.clock.sleep(stage.drawn.uniform(0.0, 1.0))
    for _ in range(_TRIES):
        with suppress(errors.TradeError):  # a device that another trouble has muted, or taken away
            stage.attach(kind)
            return
        stage.clock.sleep(0.5)


def _partition(stage: Stage, kind: RobotKind) -> None:
    stage.disturb()
    links = [(stage.system_of(name), name, DOOR if name in stage.beyond else kind.home) for name in CLIENTS]
    if stage.gateway is not None:
        links.append((stage.system, DOOR, kind.home))
    system, one, other = stage.drawn.choice(links)
    system.partition(one, other)
    stage.clock.sleep(stage.drawn.uniform(0.1, 4.0))
    system.heal(one, other)


def _delay(stage: Stage, _: RobotKind) -> None:
    jitter_s = stage.drawn.uniform(0.0, 0.1)
    for system in [stage.system] if stage.gateway is None else [stage.system, stage.gateway.clients]:
        system.delay(0.002, jitter_s=jitter_s)


# --- faults of devices


def _device(command: Callable[[random.Random], Any]) -> Callable[[Stage, RobotKind], None]:
    def do(stage: Stage, kind: RobotKind) -> None:
        stage.buses[kind.group].do(command(stage.drawn))

    return do


def _for_a_while(begin: Any, end: Any) -> Callable[[Stage, RobotKind], None]:
    def do(stage: Stage, kind: RobotKind) -> None:
        stage.buses[kind.group].do(begin)
        stage.clock.sleep(stage.drawn.uniform(0.2, 3.0))
        stage.buses[kind.group].do(end)

    return do


def _on_can(_: Cast, kind: RobotKind) -> bool:
    return kind.can


def _reports_emergencies(_: Cast, kind: RobotKind) -> bool:
    return kind.can and kind.simulator is not DamiaoBus


def _answers(drawn: random.Random) -> int:
    """How many are affected: a driver asks a servo, and a CAN device answers, some hundred times a second."""
    return drawn.choice((drawn.randrange(1, 9), drawn.randrange(9, 300)))


TROUBLES: Final[dict[str, Trouble]] = {
    "stop": Trouble(_stop),
    "estop": Trouble(_estop),
    "break lock": Trouble(_break),
    "kill": Trouble(_kill),
    "kill gateway": Trouble(_kill_gateway, lambda cast, _: cast.gateway),
    "restart driver": Trouble(_restart_driver),
    "partition": Trouble(_partition),
    "delay": Trouble(_delay),
    "brown-out": Trouble(_device(lambda _: BrownOut(ids=(1,)))),
    "mute": Trouble(_device(lambda drawn: Mute(ids=(1,), count=_answers(drawn)))),
    "late": Trouble(_device(lambda drawn: Late(ids=(2,), count=_answers(drawn), s=drawn.uniform(0.001, 0.1)))),
    "bad checksum": Trouble(_device(lambda drawn: BadCrc(ids=(1,), count=drawn.randrange(1, 9)))),
    "jam": Trouble(_for_a_while(Jam(ids=(1,)), Jam(ids=(1,), on=False))),
    "absent": Trouble(_for_a_while(Absent(ids=(2,)), Absent(ids=(2,), on=False))),
    "unplug": Trouble(_for_a_while(Unplug(), Replug())),
    "bus off": Trouble(_for_a_while(BusOff(), BusOff(on=False)), _on_can),
    "full queue": Trouble(_for_a_while(Absent(), Absent(on=False)), _on_can),
    "lost heartbeats": Trouble(_device(lambda drawn: Mute(instruction="heartbeat", count=_answers(drawn))), _on_can),
    "emergency": Trouble(_device(lambda _: Emergency(ids=(1,), code=0x4310)), _reports_emergencies),
    "clock step": Trouble(
        lambda stage, _: stage.clock.step_wall_clock(stage.drawn.choice((-3600.0, -2.0, 2.0, 3600.0)))
    ),
    "stalls": Trouble(lambda stage, _: stage.clock.stall_threads(_STALL, spare="sim-")),  # no device stalls with it
}
