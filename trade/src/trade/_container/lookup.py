"""Lookup: finds services by constraints, and calls them."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from trade._calls import batch
from trade._calls.handle import Bound, CallHost, Handle
from trade._container.reachability import Reachability, look_around
from trade._context.call_context import patience_s
from trade._discovery.dialer import Dialer
from trade._protocol.keys import DOMAIN, ServiceKey
from trade._registry.constraints import Constraint, where
from trade._registry.registry import Record, Registry
from trade._registry.suggestions import asked_for, no_such_service, too_many_services
from trade._security.authorizer import Authorizer
from trade.errors import AccessDenied


class Lookup:
    """Finds and calls the services of the whole system."""

    def __init__(
        self,
        home: CallHost,
        registry: Registry,
        dialer: Dialer | None,
        access: Authorizer,
        system: str,
        check_open: Callable[[], None],
    ) -> None:
        self.home: Final = home
        self._registry = registry
        self._dialer = dialer
        self._access = access
        self._system = system
        self._check_open = check_open

    # --- looking up

    def services(self, constraint: Constraint | None = None) -> list[Handle]:
        """Handles of all matching services, ordered by group and name; without a constraint, of all services."""
        self._check_open()
        wanted = where() if constraint is None else constraint
        return [Handle(self.home, record.key, record) for record in self._registry.select(wanted)]

    def find(self, constraint: Constraint, *, wait_s: float = 2.0) -> Handle:
        """The only service that matches; waits for it to appear.

        Raises:
            NoSuchService: none within ``wait_s`` seconds.
            TooManyServices: more than one.
        """
        self._check_open()
        matches: list[Record] = []

        def found() -> bool:
            matches[:] = self._registry.select(constraint)
            return bool(matches)

        self.await_services(constraint, found, wait_s)
        if len(matches) > 1:
            raise too_many_services(constraint, matches)
        return Handle(self.home, matches[0].key, matches[0])

    def await_services(self, constraint: Constraint, ready: Callable[[], bool], wait_s: float) -> None:
        """Waits until a condition on the services of a constraint holds.

        Args:
            constraint: what the services match; the error suggests similar ones.
            ready: the condition; checked now and after every change.
            wait_s: how long to wait, in seconds.

        Raises:
            NoSuchService: the condition does not hold within ``wait_s`` seconds.
        """
        wait_s = patience_s(wait_s)
        if self._registry.wait_for(ready, wait_s):
            return
        apart = self._unanswered(wait_s) if len(self._registry.containers()) == 1 else ()
        hidden = self._access.hidden(self.home.address.identity, asked_for(constraint, "group"))
        raise no_such_service(constraint, self._registry.select(where()), wait_s, apart, hidden)

    def _unanswered(self, wait_s: float) -> Sequence[str]:
        """Endpoints without a container; the reasons, at half a second each, only if the caller does not wait."""
        reach = self._dialer
        if wait_s > 0 or reach is None:
            return self.reachability(limit_s=0).unanswered
        return tuple(f"{endpoint} (TRADE_CONNECT)" for endpoint in reach.configured)

    def reachability(self, *, limit_s: float = 3.0) -> Reachability:
        """The containers that it has found: without them, an empty answer of the system means nothing.

        Returns at once when it is `Reachability.complete`.

        Args:
            limit_s: how long to wait for that, in seconds; also if no container is found. Finding the reason for each
                missing link takes up to 3 s more.
        """
        self._check_open()
        return look_around(self._registry, self._dialer, self.home.address, self._system, limit_s)

    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""
        return Handle(self.home, key, self._registry.get(key))

    # --- calling

    def call(self, constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
        """Calls the only service that matches. Raises the errors of `find` and of the call."""
        return self.find(constraint)(*args, **kwargs)

    def call_all(
        self, which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any
    ) -> list[batch.Outcome]:
        """Calls several services at once and waits for all of them.

        Args:
            which: a constraint (all that match now), or handles; bound calls have their own arguments.
            args: positional arguments of each call.
            kwargs: arguments of each call by name.

        Returns:
            An outcome for each call, in order; an error is the outcome of its call and stops no other.
        """
        return batch.all_outcomes(self._bound(which, args, kwargs))

    def call_sequence(self, calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[batch.Outcome]:
        """Makes calls one after the other.

        Args:
            calls: bound calls, or handles of services without arguments.
            go_on: whether to continue after an error; else it stops there.

        Returns:
            The outcomes of the calls that ran.
        """
        return batch.sequence(self._bound(calls, (), {}), go_on=go_on)

    async def acall(self, constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
        """`call` from asyncio."""
        handle = await asyncio.to_thread(self.find, constraint)
        return await handle.acall(*args, **kwargs)

    async def acall_all(
        self, which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any
    ) -> list[batch.Outcome]:
        """`call_all` from asyncio."""
        return await batch.all_outcomes_async(self._bound(which, args, kwargs))

    async def acall_sequence(self, calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[batch.Outcome]:
        """`call_sequence` from asyncio."""
        return await batch.sequence_async(self._bound(calls, (), {}), go_on=go_on)

    def ask_all(self, name: str, *args: Any) -> list[Any]:
        """The results of one of the middleware's own services in all containers, except those that leave meanwhile.

        Raises:
            AccessDenied: one of them does not allow it.
        """
        outcomes = self.call_all(where(name=name, group=DOMAIN), *args)
        denied = next((outcome.error for outcome in outcomes if isinstance(outcome.error, AccessDenied)), None)
        if denied is not None:
            raise denied
        return [outcome.result for outcome in outcomes if outcome.ok]

    def _bound(
        self, which: Constraint | Iterable[Handle | Bound], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> list[Bound]:
        self._check_open()
        return batch.bound(self.services(which) if isinstance(which, Constraint) else which, args, kwargs)
