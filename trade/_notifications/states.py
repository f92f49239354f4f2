"""The states of a container that only its components know, as services, and the events when they change."""

from collections.abc import Callable, Sequence

from trade._discovery.dialer import Dialer
from trade._discovery.link_table import LinkTable, NetworkInfo, network
from trade._notifications.events import EventLog, StateEvent
from trade._registry.constraints import as_constraint, services_at
from trade._registry.registry import Change, Record, Registry
from trade._security.certificates import Certificate
from trade._services.decorator import service
from trade._telemetry.spans import Spans
from trade.call_model import CallModel, CallProfile, CallWatch, deviations, learn, made_here
from trade.protocol.keys import CLOCK, DOMAIN, Address, ServiceKey
from trade.transport.zenoh_links import Links


class States:
    """Knows the states of one container, and notes an event when one changes."""

    def __init__(
        self,
        container: str,
        events: EventLog,
        registry: Registry,
        dialer: Dialer | None,
        links: Links | None,
        certificate: Certificate | None,
        bridge: Sequence[str],
        answers: Callable[[Address], int],
        spans: Spans,
        trace: Callable[[bool], bool],
    ) -> None:
        self._container = container
        self._registry = registry
        self._dialer = dialer
        self._links = links
        self._certificate = certificate
        self._bridge = bridge
        self._spans = spans
        self._trace = trace
        self._watch: CallWatch | None = None
        self.events = events
        self.links = LinkTable(links, registry, answers, events.note)

    def network(self) -> NetworkInfo:
        """How the container is linked and can be reached now."""
        return network(self._container, self._dialer, self._links, self.links, self._bridge, self._certificate)

    # --- what changes, as the components report it

    def changed(self, change: Change) -> None:
        """Called by the registry: containers come and go with their services ``clock``."""
        for record in (record for record in change.joined if _is_clock(record)):
            self.events.note("container_joined", record.container, record.host, record)
        for record in (record for record in change.left if _is_clock(record)):
            self.events.note("container_left", record.container, record.host, record)

    def hook_suspended(self, hook: str, error: str, call: ServiceKey | None) -> None:
        """A hook, which last called this service, failed too often."""
        self.events.note("hook_suspended", hook, error, None if call is None else self._registry.get(call))

    def listener_changed(self, key: ServiceKey, listener: tuple[str, str], joined: bool) -> None:
        """A listener of a service, by its session and name, came or went."""
        record = self._registry.get(key)
        label = f"{key.domain}.{key.name}" if record is None else record.label
        self.events.note("listener_joined" if joined else "listener_left", label, listener[0], record)

    def _deviated(self, before: str, after: str, call_id: int) -> None:
        found = self._registry.select(as_constraint(after, "call_deviated", services_at))
        text = f"call {call_id} came after {before}, which is new"
        self.events.note("call_deviated", after, text, found[0] if found else None)

    # --- calls

    def profile(self) -> CallProfile:
        """The sequences of the calls that the container made, and what deviates from usual ones."""
        spans, watch = list(filter(made_here, self._spans.kept())), self._watch
        found = [] if watch is None else deviations(spans, watch.usual)
        return CallProfile(model=learn(spans), watched=watch is not None, deviations=found)

    def watch(self, usual: CallModel | None) -> bool:
        """Compares calls with a model from now on. Returns whether some were compared before."""
        was = self._watch is not None
        self._watch = None if usual is None else CallWatch(usual, self._deviated)
        self._spans.watch = None if self._watch is None else self._watch.see
        if usual is not None:
            self._trace(True)
        return was


class StateServices:
    """Gives the states of this container and its newest events to clients, and switches the watch on its calls."""

    def __init__(self, states: States) -> None:
        self._states = states

    @service(effect="read")
    def network(self) -> NetworkInfo:
        """Its links, endpoints, discovery and broadcast, and the end of its certificate."""
        return self._states.network()

    @service(effect="read")
    def state_events(self, after: int = 0) -> list[StateEvent]:
        """Its newest events after that number, oldest first."""
        return self._states.events.after(after)

    @service(effect="read")
    def call_profile(self) -> CallProfile:
        """Which service it called after which, and what deviates from usual calls."""
        return self._states.profile()

    @service
    def watch_calls(self, usual: CallModel | None) -> bool:
        """Traces and compares its calls with usual ones; returns whether it did before."""
        return self._states.watch(usual)


def _is_clock(record: Record) -> bool:
    return record.key.domain == DOMAIN and record.name == CLOCK and not record.local
