"""Checks of presence: the sign of life, the registry answers, the tally, and the end."""

import signal
from typing import Final

from trade.protocol.keys import is_chunk, registry_key, tally_key
from trade.protocol.messages import ServiceInfo, Tally, decode_tally
from trade_checks.conformance._assertions import NotHeld, eventually, require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._peer import GROUP, RegistryReply
from trade_checks.conformance._raw_client import NEVER, SYSTEM

ARM: Final = {
    "echo": ("read", ("value",)),
    "turn": ("actuate", ("angle_rad",)),
    "angle": ("read", ()),
    "turns": ("read", ()),
    "halt": ("stop", ()),
    "relay": ("actuate", ("service", "resources", "args")),
}
"""The services of the container under test: effect and parameters."""
MOVES: Final = ("turn", "angle", "turns", "halt")
"""The names of the services for motion."""
OWN: Final = {
    "clock": "read",
    "acquire": "actuate",
    "renew": "stop",
    "release": "stop",
    "locks": "read",
    "break_lock": "stop",
    "resume": "actuate",
}
"""The functions that every container's own provider has."""
_TALLY_S: Final = 20.0
"""A little more than the longest pause between two tallies, in seconds."""


@check("presence", "Presence and registry", still=True)
def presence(stage: Stage) -> None:
    """It has one sign of life on alive/<identity>/<container>/<epoch>, as the environment names them."""
    boots = stage.boots() if stage.peer else []
    require(len(boots) == 1, f"it has {len(boots)} signs of life: {', '.join(map(str, boots))}")
    require(is_chunk(boots[0].epoch), f"its epoch {boots[0].epoch!r} is not a plain chunk")


@check("offers", "Presence and registry", still=True)
def offers(stage: Stage) -> None:
    """It answers the registry query with its entries on their own keys, and the tally last."""
    offer = stage.peer.offer()
    require(offer.tally >= 1 and offer.last == "tally", "the tally is not the last thing in its answer")
    for place, info in offer.entries.items():
        own = registry_key(place[0], stage.peer.address, place[1])
        require(own in offer.keys, f"the entry of {'/'.join(place)} is not on {own}")
        require(info.revision <= offer.tally, f"the revision of {'/'.join(place)} is above the tally")
        if place != SYSTEM:
            require(info.groups[:1] == place[:1], f"{place[0]} is not the first group of {'/'.join(place)}")
    revisions = [info.revision for info in offer.entries.values()]
    require(len(set(revisions)) == len(revisions), "two entries have the same revision")


@check("describes", "Messages", still=True)
def describes(stage: Stage) -> None:
    """The services of group peer and the functions of its own provider are described as agreed."""
    wanted = {name: parts for name, parts in ARM.items() if stage.motion or name not in MOVES}
    places = {name: stage.peer.place(name) for name in wanted}
    offer = stage.peer.offer()
    arm = {name: _services(offer, place)[name] for name, place in places.items()}
    for name, (effect, parameters) in wanted.items():
        found = arm[name]
        require(found.effect == effect, f"{name} has the effect {found.effect!r}, not {effect!r}")
        named = tuple(parameter.name for parameter in found.parameters)
        require(named == parameters, f"{name} has the parameters {named}, not {parameters}")
    if stage.motion:
        require(arm["turn"].uses, "turn names no resource that it uses")
        require(set(arm["turn"].uses) == set(arm["halt"].uses), "halt does not stop what turn uses")
    require(arm["relay"].uses == (), "relay uses no resource")
    own = _services(offer, SYSTEM)
    for name, effect in OWN.items():
        require(name in own, f"its own provider has no {name}")
        require(own[name].effect == effect, f"trade.{name} has the effect {own[name].effect!r}, not {effect!r}")


@check("reports-late", "Presence and registry", still=True)
def reports_late(stage: Stage) -> None:
    """It publishes its tally at least every sixteen seconds."""
    with stage.listening(tally_key(stage.peer.address)) as heard:
        eventually(lambda: len(heard) > 0, "it did not publish its tally", _TALLY_S)
        tallies = [_tally(message.payload) for message in heard]
    require(tallies[-1].revision == stage.peer.offer().tally, "its tally is not that of its answer")


@check("found", "Presence and registry", still=True)
def found(stage: Stage) -> None:
    """A container of this project finds its services and calls them."""
    from trade import where  # noqa: PLC0415 - the public way, here only

    arm = stage.peer.place("echo")
    handle = stage.container.find(where(name="echo", group=GROUP), wait_s=10.0)
    require((handle.key.domain, handle.key.provider) == arm, f"{handle} was found, not the one of {arm}")
    require(handle("one") == "one", "echo answered something else")


@check("survives-rubbish", "Messages", still=True)
def survives_rubbish(stage: Stage) -> None:
    """It drops malformed messages on any key, and survives them."""
    peer, echo = stage.peer, stage.peer.place("echo")
    place = "/".join(echo)
    rubbish = [b"", b"\xc1", b"\xff" * 40, b"\x91" * 5000, b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff\x01"]
    rubbish += [b"\x80", b"\x90", b"\x99\x01\x01", b"\xc7\xff\x01" + b"\x00" * 8, b"\xa3\xff\xfe\xfd", b"\x01"]
    keys = [f"call/anna/{peer.address}/{place}", f"stop/anna/{peer.address}/{place}", "estop/anna"]
    keys += [f"call/anna/{peer.address}/trade/system", f"stop/anna/{peer.address}/trade/system", "estop/anna/x/y"]
    keys += ["registry/trade/anna/suite/nowhere/system", "registry/trade/anna/suite/nowhere/tally"]
    with stage.voice() as anna:
        for key in keys:
            for payload in rubbish:
                anna.put(key, payload)
        require(anna.result(echo, "echo", 1, expires_ns=NEVER) == 1, "after malformed messages echo answers wrongly")
    require(peer.alive, f"malformed messages ended it: {stage.last_words()}")


@check("restarts", "Keys")
def restarts(stage: Stage) -> None:
    """After a kill and a restart it has another epoch, and receives nothing that was sent to the earlier one."""
    before, arm = stage.kill(), stage.peer.arm
    require(stage.peer.address.epoch != before.address.epoch, "it has the epoch that it had before")
    with stage.voice() as anna:
        began = stage.turns(anna)
        lost = anna.call(arm, "turn", 0.1, callee=before.address)
        read = anna.call(arm, "angle", callee=before.address)
        require(stage.turns(anna) == began, "a call to an earlier epoch ran")
        require(not anna.answers(lost) and not anna.answers(read), "a call to an earlier epoch was answered")


@check("leaves", "Presence and registry", still=True)
def leaves(stage: Stage) -> None:
    """On SIGTERM it ends by itself, and its sign of life vanishes."""
    peer = stage.peer
    peer.signal(signal.SIGTERM)
    eventually(lambda: peer.process.poll() is not None, "it does not end on SIGTERM")
    eventually(lambda: not stage.seen(peer.address), "its sign of life remains after its end")


def _services(offer: RegistryReply, place: tuple[str, str]) -> dict[str, ServiceInfo]:
    entry = offer.entries.get(place)
    if entry is None:
        raise NotHeld(f"it has no provider {'/'.join(place)}")
    return {service.name: service for service in entry.services}


def _tally(payload: bytes | None) -> Tally:
    return decode_tally(payload or b"")
