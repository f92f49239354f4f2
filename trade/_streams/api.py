"""The stream methods of a container: a service is sampled while the stream is open."""

import contextlib
import logging
import math
import time
from collections.abc import Callable
from typing import Final, cast

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.sessions import speaking
from trade._notifications.triggers import Action, Target, What, target_of
from trade._registry.constraints import Constraint, as_constraint, service_at
from trade._streams.source import LEAST_HZ, MOST_HZ, check_sampled
from trade._streams.stream import If, Stream
from trade._streams.subscriptions import Subscriptions
from trade._threads.scheduler import Scheduler
from trade.errors import ConfigurationError, ServiceGone, SourceLost
from trade.protocol.samples import Value

_logger = logging.getLogger("trade")

_MOST_KEPT = 100_000
_AGAIN: Final = ". trade.joined(where(...), call=listen, existing=True) can open another stream when it is back"


class StreamApi:
    """The streams of this container."""

    def __init__(self, client: CallClient, subscriptions: Subscriptions, scheduler: Scheduler) -> None:
        self._client = client
        self._subscriptions = subscriptions
        self._scheduler = scheduler

    def stream(
        self,
        target: Callable[..., Value] | Constraint | str,
        *,
        hz: float = 10.0,
        on_change: bool = False,
        if_: If | None = None,
        call: What | None = None,
        keep: int = 16,
    ) -> "Stream[Value]":
        """Samples a service while the stream is open: ``with container.stream(state, hz=20) as samples:``.

        Its own container calls it, once for all subscribers, at the highest of their rates; without subscribers it is
        not called at all. The stream ends with `Stream.close`, the session that opened it, or this container.

        Args:
            target: a service that only reads and needs no arguments, as a handle, as text by its group and name, or as
                a constraint that only it matches. Type checkers know the values of ``stream(arm.state)``.
            hz: the most samples per second, from 0.001 to 1000.
            on_change: only samples that differ from the one before.
            if_: only samples for whose value this returns True; a function of this process.
            call: call this with each value instead of buffering them: a handle, a bound call, a constraint that one
                service matches, or a function. One call at a time; a slow one gets the newest value.
            keep: how many samples are buffered; the oldest is dropped first.

        Raises:
            NoSuchService, TooManyServices: no service matches, or more than one.
            AccessDenied: the policy does not let this container read it.
            ConfigurationError: it cannot be sampled, the rate is not valid, or ``call`` is not callable.
            ServiceGone: it was deregistered.
        """
        _check("hz", hz, LEAST_HZ, MOST_HZ)
        _check("keep", keep, 1, _MOST_KEPT)
        which = _which(target)
        if if_ is not None and (isinstance(if_, Handle) or not callable(if_)):
            problem = f"if_ must be a function of the value, not {if_!r}"
            raise ConfigurationError(where="trade.stream", problem=problem)
        pushed = None if call is None else target_of(call, "trade.stream", "call", 1)
        source = which if isinstance(which, Handle) else self._client.find(which)
        check_sampled(source)
        session = speaking.get()
        opened_by = session if session is not None and session.owner == self._client.address else None
        stream = self._subscriptions.open(source, hz, on_change=on_change, if_=if_, keep=keep, opened_by=opened_by)
        if pushed is not None:
            _Push(self._client, stream, pushed, self._scheduler)
        return stream


class _Push:
    """Calls a target with each value of a stream, one at a time."""

    def __init__(self, client: CallClient, stream: Stream, target: Target, scheduler: Scheduler) -> None:
        self._client = client
        self._stream = stream
        self._target = target
        self._problem = ""
        due = scheduler.due(self._act)
        stream.on_sample(lambda: due.at(time.monotonic_ns()))
        due.at(time.monotonic_ns())  # samples may have arrived already

    def _act(self) -> None:
        while True:
            try:
                sample = self._stream.take()
                if sample is None:
                    return
                self._do(sample.value)
                self._problem = ""
            except BaseException as error:  # noqa: BLE001 - an error of the target must not end the stream
                over = error is self._stream.why_ended
                if not (over and isinstance(error, ConfigurationError)):  # closed on purpose
                    self._failed(error)
                if over:
                    return

    def _do(self, value: object) -> None:
        opened_by, target = self._stream.opened_by, self._target
        with contextlib.nullcontext() if opened_by is None else opened_by.use():
            if not isinstance(target, Action):
                target(value)
                return
            handle = target.handle
            if handle is None:
                assert target.constraint is not None  # noqa: S101
                handle = self._client.find(target.constraint, wait_s=0)
            handle(value, *target.args, **target.kwargs)

    def _failed(self, error: BaseException) -> None:
        kind = type(error).__name__
        if kind != self._problem:  # a repeated kind of error is not logged again
            hint = _AGAIN if isinstance(error, SourceLost | ServiceGone) else ""
            _logger.warning("a sample of %r was not passed on: %s: %s%s", self._stream, kind, error, hint)
        self._problem = kind


def _which(target: object) -> Handle | Constraint:
    if isinstance(target, Handle):
        return cast("Handle", target)
    return as_constraint(target, "trade.stream", service_at)


def _check(name: str, value: float, least: float, most: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)  # pyright: ignore[reportUnnecessaryIsInstance]
    if not number or not math.isfinite(value) or not least <= value <= most:
        problem = f"{name} must be from {least:g} to {most:g}, not {value!r}"
        raise ConfigurationError(where="trade.stream", problem=problem)
