"""The product broken on purpose, each in one way; as a plugin (``-p tests.support.mutants``) tests are run on one.

``MUTANT`` in the environment says which. `tests.support.everywhere` breaks the processes that a test starts. Broken
locks have a place of their own: `tests.endurance.chaos._mutants`.
"""

import os
from collections.abc import Callable
from typing import Any, Final

from tests.support import waiting

Patch = Callable[[Any, str, Any], object]
"""As `setattr`."""
PATHS: Final = {"local path": "1", "transport": "0"}
"""The ways that calls on one host can take, and what ``TRADE_LOCAL_PATH`` is for each."""
_IMPATIENCE_S: Final = 6.0
"""How long a test waits for what a mutant never does."""


def _nothing_stops(patch: Patch) -> None:
    """Who is gone, and what he has lost, is of no concern."""
    from trade._estop.deadman import Deadman
    from trade._resources.resource import Permit

    patch(Deadman, "stop", lambda self, resources, reason, done: [done(resource, "") for resource in resources])
    patch(Permit, "gate", lambda self: None)


def _anybody_may(patch: Patch) -> None:
    """No lock is looked at."""
    from trade._resources.resource import Permit, Resource

    patch(Resource, "check", lambda self, *_: None)
    patch(Permit, "gate", lambda self: None)


def _never_late(patch: Patch) -> None:
    """Calls and commands run however late they come."""
    from trade._services.local_service import LocalService
    from trade_drivers.bus._gate import Command

    patch(LocalService, "too_late", lambda self, _: False)
    patch(Command, "gate", lambda self: self.permit.gate())


def _no_dedupe(patch: Patch) -> None:
    """A call that comes again runs again."""
    from trade._context.active_calls import CallDeduplicator

    patch(CallDeduplicator, "begin", lambda self, call, ongoing: ongoing)
    patch(CallDeduplicator, "find", lambda self, caller, call: None)


def _stop_loses(patch: Patch) -> None:
    """What was asked for before a stop is done after it."""
    from trade._resources.resource import Resource

    patch(Resource, "stop", lambda self, *_, **__: None)


def _watchdog_off(patch: Patch) -> None:
    """The watchdogs of servos are not armed."""
    from trade_drivers.vendors.dynamixel._exchange import DynamixelExchange

    begin = DynamixelExchange.__init__

    def unwatched(self: Any, *args: Any, **options: Any) -> None:
        begin(self, *args, **options)
        self.watchdog_counts = 0

    patch(DynamixelExchange, "__init__", unwatched)


def _late_wake(patch: Patch) -> None:
    """A stop that comes when the stops were just served waits for the next cycle."""
    from trade_drivers.bus._cycle import BusCycle

    patch(BusCycle, "idle", lambda self, s: (self.wake.wait(s), self.serve_stops(), self.wake.clear()))


def _one_still_sample(patch: Patch) -> None:
    """A joint that one measurement shows at rest is left alone by a stop."""
    from trade_drivers.joints._cycle import Exchange

    patch(Exchange, "_at_rest", lambda self, axis, now_ns: axis.motion is None and axis.still >= 1)


def _no_margin(patch: Patch) -> None:
    """A motion continues until the deadline of its call, when its caller no longer waits for the answer."""
    from trade_drivers.bus import _gate

    patch(_gate, "_ANSWER_NS", 0)


def _discovery_stays_on(patch: Patch) -> None:
    """A search for containers never ends."""
    from trade._discovery.dialer import Dialer

    switch = Dialer.set_discovery
    patch(Dialer, "set_discovery", lambda self, on: switch(self, on or self.discovers))


def _uses_uncounted(patch: Patch) -> None:
    """Calls under a lock are not counted."""
    from trade._resources.resource import Resource

    check = Resource.check_lock

    def uncounted(self: Any, *args: Any) -> None:
        before = self.uses, self.used_at
        check(self, *args)
        self.uses, self.used_at = before

    patch(Resource, "check_lock", uncounted)


def _no_priority(patch: Patch) -> None:
    """Clients wait in order of arrival, whatever priority they have."""
    from trade._locks import api

    request = api.LockRequest
    patch(api, "LockRequest", lambda **terms: request(**{**terms, "priority": 0}))


def _grant_unconfirmed(patch: Patch) -> None:
    """A grant counts however late its answer is read."""
    from trade._locks.lease_client import LeaseClient

    patch(LeaseClient, "_confirm", lambda self, *_: None)


def _busiest(patch: Patch) -> None:
    """What is moved goes where there is most to do."""
    from trade._migration import source as _departing

    busyness = _departing.busyness
    patch(_departing, "busyness", lambda load: tuple(-each for each in busyness(load)))


def _busiest_picked(patch: Patch) -> None:
    """The service that is picked is the one with the most to do."""
    from trade._calls import picking

    busyness = picking.busyness
    patch(picking, "busyness", lambda load, under_way: tuple(-each for each in busyness(load, under_way)))


def _twin_unplaced(patch: Patch) -> None:
    """The twin stays where it came up, and says that it is where the robot is."""
    from trade_gateway.mcp import Twin

    patch(Twin, "_place", lambda self, *_: True)


def _deviations_unseen(patch: Patch) -> None:
    """Calls are not compared with what is usual."""
    from trade.call_model import CallWatch

    patch(CallWatch, "see", lambda self, span: None)


def _no_stop_line(patch: Patch) -> None:
    """No container listens on the stop line."""
    from trade.stop_line import service

    patch(service, "host_socket", lambda _: None)
    patch(service, "_network_sockets", lambda *_: [])


def _ordinary(patch: Patch) -> None:
    """The processes of devices run as any other."""
    from trade_gateway.process._real_time import RealTime

    patch(RealTime, "take", lambda self: [])


def _first_of_several(patch: Patch) -> None:
    """A constraint that several services meet means one of them."""
    from trade._calls.client import CallClient

    matches = CallClient._await_matches
    patch(CallClient, "_await_matches", lambda self, *which: matches(self, *which)[:1])


def _discovery_never(patch: Patch) -> None:
    """No container is searched for."""
    from trade._discovery.dialer import Dialer

    patch(Dialer, "set_discovery", lambda self, on: None)


def _no_question(patch: Patch) -> None:
    """Orders in sentences are carried out without a confirmation."""
    from trade_gateway.language._dialogue import Dialogue

    say = Dialogue.say
    patch(Dialogue, "say", lambda self, sentence, **terms: say(self, sentence, **{**terms, "confirmed": True}))


def _rules_without_if(patch: Patch) -> None:
    """Rules fire whether their condition holds or not."""
    from trade.rules._file import Condition

    patch(Condition, "holds", lambda self, answer: True)


def _all_may_read(patch: Patch) -> None:
    """The dashboard shows everything to all its users."""
    from trade_gateway.clients._authorizer import ClientAuthorizer

    patch(ClientAuthorizer, "require_some", lambda self, *_: None)
    patch(ClientAuthorizer, "require_system", lambda self, *_: None)
    patch(ClientAuthorizer, "may_system", lambda self, *_: True)


def _any_order(patch: Patch) -> None:
    """The containers of a system file start in the order of the file."""
    from trade_gateway.config._tables import Tables

    patch(Tables, "_order", lambda self: list(self._entries))


HOW: Final[dict[str, Callable[[Patch], None]]] = {
    "nothing-stops": _nothing_stops,
    "anybody-may": _anybody_may,
    "never-late": _never_late,
    "no-dedupe": _no_dedupe,
    "stop-loses": _stop_loses,
    "watchdog-off": _watchdog_off,
    "late-wake": _late_wake,
    "one-still-sample": _one_still_sample,
    "no-margin": _no_margin,
    "discovery-stays-on": _discovery_stays_on,
    "uses-uncounted": _uses_uncounted,
    "no-priority": _no_priority,
    "grant-unconfirmed": _grant_unconfirmed,
    "busiest": _busiest,
    "busiest-picked": _busiest_picked,
    "twin-unplaced": _twin_unplaced,
    "deviations-unseen": _deviations_unseen,
    "no-stop-line": _no_stop_line,
    "ordinary": _ordinary,
    "first-of-several": _first_of_several,
    "discovery-never": _discovery_never,
    "no-question": _no_question,
    "rules-without-if": _rules_without_if,
    "all-may-read": _all_may_read,
    "any-order": _any_order,
}


def pytest_configure() -> None:
    """Called for a module that is named as a plugin."""
    HOW[os.environ["MUTANT"]](setattr)
    waiting.PATIENCE_S = _IMPATIENCE_S
