"""Several calls, concurrently or in sequence, each with its own outcome."""

import asyncio
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from trade._calls.handle import BoundCall, Handle
from trade._calls.run import Run

_MOST_AT_ONCE: Final = 256


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one of several calls ended."""

    handle: Handle
    result: Any = None
    error: BaseException | None = None

    @property
    def ok(self) -> bool:
        """Whether it ended with a result."""
        return self.error is None

    def value(self) -> Any:
        """Returns the result, or raises the error."""
        if self.error is not None:
            raise self.error
        return self.result


def begun(call: BoundCall) -> Run:
    """Starts a call; an error that prevents its start is its outcome, too."""
    try:
        return call.start()
    except Exception as error:  # noqa: BLE001 - any error is the outcome
        run = Run(call.handle)
        run.fail(error)
        return run


def _ended(call: BoundCall, run: Run) -> Outcome:
    error = run.exception()
    return Outcome(call.handle, error=error) if error is not None else Outcome(call.handle, run.result())


def bound(calls: Iterable[Handle | BoundCall], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> list[BoundCall]:
    """Binds the arguments to handles; bound calls stay as they are."""
    return [call if isinstance(call, BoundCall) else call.bind(*args, **kwargs) for call in calls]


def all_outcomes(calls: Iterable[BoundCall]) -> list[Outcome]:
    """Runs calls concurrently and waits for all; returns their outcomes in order."""
    return list(_waves(list(calls)))


def _waves(calls: list[BoundCall]) -> Iterator[Outcome]:
    """Runs a limited number at once, because a local call occupies a thread while it runs."""
    running = [begun(call) for call in calls[:_MOST_AT_ONCE]]
    for index, call in enumerate(calls):
        yield _ended(call, running[index])
        if len(running) < len(calls):
            running.append(begun(calls[len(running)]))


async def all_outcomes_async(calls: Iterable[BoundCall]) -> list[Outcome]:
    """The same from asyncio."""
    limit = asyncio.Semaphore(_MOST_AT_ONCE)

    async def one(call: BoundCall) -> Outcome:
        async with limit:
            return await _ended_async(call)

    return await asyncio.gather(*map(one, calls))


async def _ended_async(call: BoundCall) -> Outcome:
    run = begun(call)
    await run.settled()
    return _ended(call, run)


def sequence(calls: Iterable[BoundCall], *, go_on: bool) -> list[Outcome]:
    """Runs calls in sequence; returns the outcomes of those that ran."""
    outcomes: list[Outcome] = []
    for call in calls:
        outcomes.append(_ended(call, begun(call)))
        if not (go_on or outcomes[-1].ok):
            break
    return outcomes


async def sequence_async(calls: Iterable[BoundCall], *, go_on: bool) -> list[Outcome]:
    """The same from asyncio."""
    outcomes: list[Outcome] = []
    for call in calls:
        outcomes.append(await _ended_async(call))
        if not (go_on or outcomes[-1].ok):
            break
    return outcomes
