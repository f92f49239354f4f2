"""Checks of the container as a caller: calls of the suite's service, under its lock, and on behalf of others."""

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, NamedTuple

import msgspec

from trade import Resource, current_call, errors, service, where
from trade.protocol.keys import ServiceKey
from trade.protocol.messages import Status
from trade_checks.conformance._assertions import eventually, require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._raw_client import DEADLINE_S, RawClient, error_of

_EXTENSION = 1
_SHORT_S = 2.0


class Run(NamedTuple):
    """How the suite's service was called."""

    depth_mm: float
    caller: str
    session: str
    sessions: tuple[str, ...]
    calls: tuple[int, ...]
    chain: tuple[str, ...]
    remaining_s: float | None
    locked: bool


class RecordingProvider:
    """The provider that the container under test calls; it records the calls."""

    def __init__(self) -> None:
        self.resources = [Resource("judge.lathe")]
        self.runs: list[Run] = []
        self.go_on = threading.Event()
        self.go_on.set()

    @service
    def cut(self, depth_mm: float) -> str:
        """Cuts to a depth."""
        call = current_call()
        if call is not None:
            calls = () if call.behalf is None else call.behalf.calls
            recorded = (call.session, call.sessions, calls, call.chain, call.remaining_s)
            self.runs.append(Run(depth_mm, call.caller, *recorded, locked=self.resources[0].live != 0))
        self.go_on.wait(5.0)
        return f"{depth_mm:g} mm"

    @service
    def jam(self) -> None:
        """Always fails."""
        raise errors.DeviceSilent(device="judge.lathe", bus="jammed", waited_s=1.0)

    @service(effect="stop")
    def stop(self) -> None:
        """Stop."""


@contextmanager
def _lathe(stage: Stage) -> Generator[RecordingProvider, None, None]:
    lathe = RecordingProvider()
    stage.container.register(lathe, "judge.lathe")
    try:
        yield lathe
    finally:
        stage.container.deregister(lathe)


def _handle(stage: Stage, name: str) -> msgspec.msgpack.Ext:
    key: ServiceKey = stage.container.find(where(name=name, group="judge.lathe")).key
    return msgspec.msgpack.Ext(_EXTENSION, msgspec.msgpack.encode(key))


def _relay(stage: Stage, client: RawClient, name: str, resources: list[str], args: list[Any], **how: Any) -> int:
    return client.call(stage.peer.place("relay"), "relay", _handle(stage, name), resources, args, **how)


@check("calls", "Expiry", still=True)
def calls(stage: Stage) -> None:
    """It calls the suite's service with the right arguments, an expiry no later than its own, and its callers."""
    with stage.voice() as anna, _lathe(stage) as lathe:
        call_id = _relay(stage, anna, "cut", [], [2.5])
        reply = anna.answer(call_id)
        require(reply.status == Status.OK, f"relay was answered with status {reply.status}: {_why(reply)}")
        require(msgspec.msgpack.decode(reply.body) == "2.5 mm", "relay did not return what the suite's service did")
        require(len(lathe.runs) == 1, f"the suite's service ran {len(lathe.runs)} times")
        run = lathe.runs[0]
        require(run.depth_mm == 2.5, f"the suite's service was called with {run.depth_mm}")
        require(run.caller == "peer", f"the suite's service was called by {run.caller}")
        require(run.session.startswith("peer/peer/"), f"it called in the session {run.session}")
        require(anna.session in run.sessions, "its call does not name the session on whose behalf it is made")
        require(call_id in run.calls, "its call does not name the one that led to it")
        require(run.chain[-1:] and run.chain[-1].endswith("relay"), f"the chain of its call is {run.chain}")
        require(
            run.remaining_s is not None and run.remaining_s < DEADLINE_S, "its call outlives the one that led to it"
        )


@check("calls-no-longer", "Expiry", still=True)
def calls_no_longer(stage: Stage) -> None:
    """Its call expires no later than the call that led to it, whether that expiry is early or late."""
    with stage.voice() as anna, _lathe(stage) as lathe:
        for expires_ns in (anna.expiry_ns(_SHORT_S), 2**63 - 1):
            reply = anna.answer(_relay(stage, anna, "cut", [], [1.0], expires_ns=expires_ns))
            require(reply.status == Status.OK, f"relay was answered with status {reply.status}: {_why(reply)}")
        early, late = (run.remaining_s for run in lathe.runs)
        require(early is not None and early < _SHORT_S, f"of {_SHORT_S:g} s, {early} s remain for what it called")
        require(late is not None and late > _SHORT_S, f"of a later expiry, {late} s remain for what it called")


@check("passes-errors", "Messages", still=True)
def passes_errors(stage: Stage) -> None:
    """An error of a service that it calls reaches its own caller."""
    with stage.voice() as anna, _lathe(stage):
        found = error_of(anna.answer(_relay(stage, anna, "jam", [], [])))
        require("jammed" in str(found), f"the error of the suite's service arrived as {found!r}")


@check("locks-suite", "S11", still=True)
def locks_suite(stage: Stage) -> None:
    """It takes a lock on the suite's resources, calls under it, and releases it."""
    with stage.voice() as anna, _lathe(stage) as lathe:
        reply = anna.answer(_relay(stage, anna, "cut", ["judge.lathe"], [1.0]))
        require(reply.status == Status.OK, f"relay under a lock was answered with status {reply.status}: {_why(reply)}")
        require(lathe.runs[0].locked, "the suite's service ran without the lock")
        eventually(lambda: lathe.resources[0].live == 0, "it did not release the lock")


@check("renews", "S12", still=True)
def renews(stage: Stage) -> None:
    """It renews a lock for as long as it uses it."""
    with stage.voice() as anna, _lathe(stage) as lathe:
        lathe.go_on.clear()
        call_id = _relay(stage, anna, "cut", ["judge.lathe"], [1.0])
        eventually(lambda: lathe.runs, "the suite's service was not called")
        threading.Event().wait(2.6)  # longer than the lease of 2 s
        require(lathe.resources[0].live != 0, "the lock was not renewed within its lease of 2 s")
        lathe.go_on.set()
        require(anna.answer(call_id).status == Status.OK, "the call under the lock failed")
        eventually(lambda: lathe.resources[0].live == 0, "it did not release the lock")


@check("is-refused", "S11", still=True)
def is_refused(stage: Stage) -> None:
    """While another client has the lock, it is refused and reports that to its caller."""
    with stage.voice() as anna, _lathe(stage) as lathe:
        with stage.container.lock(where(group="judge.lathe"), purpose="a check"):
            for resources in ([], ["judge.lathe"]):
                found = error_of(anna.answer(_relay(stage, anna, "cut", resources, [1.0])))
                require(isinstance(found, errors.LockedByOther), f"without the lock it was refused with {found!r}")
        require(not lathe.runs, "the suite's service ran without the lock")


@check("streams", "Streams", needs="listen")
def streams(stage: Stage) -> None:
    """It publishes the samples of a reading service while there is a subscriber."""
    handle = stage.container.find(where(name="angle", group="peer"), wait_s=10.0)
    with stage.voice() as anna, stage.container.stream(handle, hz=20) as stream:
        require(stream.next(5.0).value == stage.angle(anna), "a sample differs from angle()")


def _why(reply: Any) -> str:
    return str(error_of(reply)) if reply.status == Status.ERROR else ""
