"""What a call costs with what may be added to it: certificates and a policy, hooks, a lock that its caller holds.

Calls of 64 B, one at a time, interleaved with the plain call and with bare pairs, so that each addition is a ratio.
"""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final

from tests.bench._across import bare_session
from tests.bench._calls import CPU, P50, Results, measure, print_latency, ratios, up
from tests.bench._children import Job
from tests.bench._links import Link
from tests.bench._peers import BarePair, bare_link, serve_bare
from tests.bench._trade import Trade
from tests.support.certificates import Papers
from tests.support.policies import policy_text

_SIZE: Final = 64
_HOOKS: Final = (1, 10)
_CALLS, _REPLIES = "call/planner/robot/bare/0/bench/pair", "reply/robot/planner/bare/0"
_POLICY: Final = policy_text(
    "robot=driver planner=operator", driver="register=bench", operator="read=* call=bench lock=bench"
)


def run(n: int, rounds: int) -> None:
    """Measure and print.

    Args:
        n: calls of each kind in a round.
        rounds: how often each kind has its turn.
    """
    with tempfile.TemporaryDirectory() as folder:
        papers, policy = Papers(Path(folder) / "pki"), Path(folder) / "policy.toml"
        policy.write_text(_POLICY)
        issued = {name: papers.of(name, addresses=["127.0.0.1"]) for name in ("robot", "planner")}
        kinds = (
            BarePair(),
            _BareTls(issued),
            Joint(),
            Joint(locked=True),
            *(Joint(hooks=hooks) for hooks in _HOOKS),
            _SecureJoint(issued, policy),
        )
        with up(kinds) as peers:
            job = Job(_SIZE, n)
            results = measure("what is added to calls", peers, job, rounds)
    print_latency("remote call of 64 B, and what is added to it", results, job)
    _print_costs(results)


def _print_costs(results: Results) -> None:
    for what, one, other in (
        ("TLS: a bare pair", _BareTls.name, BarePair.name),
        ("TLS and a policy: a call", _SecureJoint.name, Joint.name),
        ("a lock that is held: a call", "TRADE, lock held", Joint.name),
        *((f"hooks, {hooks}: a call", f"TRADE, hooks: {hooks}", Joint.name) for hooks in _HOOKS),
    ):
        shares = [ratios(results[one], results[other], *of) for of in (P50, CPU)]
        p50, cpu = (median(share) for share in shares)
        print(f"{what:28} takes {p50:5.2f} x the p50, {cpu:5.2f} x the CPU")


class Joint(Trade):
    """A call of a service that moves a joint: its resource is checked, locked or not, and its hooks are called."""

    name = "TRADE"

    def __init__(self, *, locked: bool = False, hooks: int = 0) -> None:
        self.locked, self.hooks = locked, hooks
        if locked:
            self.name = "TRADE, lock held"
        elif hooks:
            self.name = f"TRADE, hooks: {hooks}"
        self.system = f"bench-joint-{int(locked)}-{hooks}"

    @contextmanager
    def serve(self) -> Iterator[str]:
        joint, watch = _kinds()
        endpoint = self.endpoint()
        with self.container("robot", listen=[endpoint]) as container:
            container.register(joint(), "bench")
            for number in range(self.hooks):
                [see] = container.register(watch(), f"watch.{number}")
                container.before_service(container.find(_echo()), see)
            yield endpoint

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with self.container("planner", connect=[address]) as container:
            handle = container.find(_echo(), wait_s=10)
            if not self.locked:
                yield self.link(handle)
                return
            with container.lock([handle]):
                yield self.link(handle)

    def endpoint(self) -> str:
        from trade.transport.endpoints import free_endpoint

        return free_endpoint()

    def container(self, name: str, **how: Any):
        from trade import Container, Settings

        return Container(Settings.read(container=name, system=self.system, **how))


class _SecureJoint(Joint):
    """The same with certificates on both ends, and a policy that says who may call what."""

    name = "TRADE, TLS and policy"

    def __init__(self, papers: Mapping[str, Path], policy: Path) -> None:
        super().__init__()
        self.system = "bench-joint-tls"
        self._papers, self._policy = papers, policy

    def endpoint(self) -> str:
        return super().endpoint().replace("tcp/", "tls/")

    def container(self, name: str, **how: Any):
        own = {"listen": ["tls/127.0.0.1:0"]} | how
        return super().container(name, tls=self._papers[name], policy=self._policy, **own)


class _BareTls(BarePair):
    """The bare pair with the same certificates."""

    name = "bare pair, TLS"

    def __init__(self, papers: Mapping[str, Path]) -> None:
        self._papers = papers

    @contextmanager
    def serve(self) -> Iterator[str]:
        from trade.transport.endpoints import free_endpoint

        endpoint = free_endpoint().replace("tcp/", "tls/")
        with bare_session([endpoint], [], self._papers["robot"], None) as session:
            serve_bare(session, _CALLS, _REPLIES)
            yield endpoint

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with bare_session(["tls/127.0.0.1:0"], [address], self._papers["planner"], None) as session:
            yield bare_link(session, _CALLS, _REPLIES)


def _echo():
    from trade import where

    return where(name="echo", group="bench")


def _kinds() -> tuple[type, type]:
    """A joint, and what watches it."""
    from trade import HookEvent, service

    class Joint:
        resources = ("bench.joint",)

        @service
        def echo(self, payload: bytes) -> bytes:
            return payload

        @service(effect="stop")
        def stop(self) -> None:
            """Nothing moves here."""

    class Watch:
        @service(effect="read")
        def see(self, called: HookEvent) -> None:
            """Nothing is done with it."""

    return Joint, Watch
