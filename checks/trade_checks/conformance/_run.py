"""Runs the checks in order, each on a container at rest."""

import logging
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import Final

from msgspec import Struct

from trade.errors import TradeError
from trade_checks.conformance import _callbacks, _calling, _estopping, _locking, _moving, _presence
from trade_checks.conformance._assertions import NotHeld
from trade_checks.conformance._check import Check
from trade_checks.conformance._environment import Stage

CHECKS: Final[tuple[Check, ...]] = (
    _presence.presence,
    _presence.offers,
    _presence.describes,
    _presence.reports_late,
    _presence.found,
    _presence.survives_rubbish,
    _presence.restarts,
    _presence.leaves,
    _calling.answers,
    _calling.refuses_arguments,
    _calling.knows_not,
    _calling.late_is_never,
    _calling.late_when_frozen,
    _calling.once,
    _calling.once_without_expiry,
    _calling.once_for_each,
    _calling.cancels,
    _calling.cancels_own_only,
    _calling.versions,
    _calling.forged,
    _moving.turns,
    _moving.stops,
    _moving.stops_late,
    _moving.stop_latches,
    _moving.stop_latches_own,
    _moving.session_ends,
    _moving.caller_ends,
    _moving.behalf_ends,
    _moving.too_late_for_ended,
    _locking.locks,
    _locking.locks_shown,
    _locking.locked_by_suite,
    _locking.one_owner,
    _locking.waits_for_motion,
    _locking.leases,
    _locking.owner_ends,
    _locking.lost_stops,
    _locking.stop_needs_no_lock,
    _locking.stop_beside_waiting,
    _callbacks.calls,
    _callbacks.calls_no_longer,
    _callbacks.passes_errors,
    _callbacks.locks_suite,
    _callbacks.renews,
    _callbacks.is_refused,
    _callbacks.streams,
    _estopping.estop,
    _estopping.estop_reported,
    _estopping.estop_forged,
    _estopping.estop_of_any_version,
    _estopping.estop_kept,
    _estopping.estop_learnt,
)


class Result(str, Enum):
    """The result of one check."""

    OK = "ok"
    FAILED = "failed"
    LEFT_OUT = "left out"


class Outcome(Struct, frozen=True):
    """The outcome of one check."""

    check: str
    what: str
    rule: str
    outcome: Result
    why: str = ""
    took_s: float = 0.0


def run(
    command: str, checks: Sequence[Check], report: Callable[[Outcome], None], *, motion: bool = False
) -> list[Outcome]:
    """Starts the container under test and runs the checks on it.

    Args:
        command: starts it; split into words as in a shell, but run without one.
        checks: the checks to run.
        report: called with each outcome at once.
        motion: whether its arm may be turned; otherwise such checks are skipped, and ``turn`` is never called.

    Raises:
        ConfigurationError: there is no such program.
    """
    outcomes: list[Outcome] = []
    logging.getLogger("trade").setLevel(logging.CRITICAL)  # our own container drops messages here on purpose
    with (
        tempfile.TemporaryDirectory(prefix="trade-conformance-") as folder,
        Stage(command, Path(folder), motion=motion) as stage,
    ):
        for outcome in _each(stage, checks):
            outcomes.append(outcome)
            report(outcome)
    return outcomes


def _each(stage: Stage, checks: Sequence[Check]) -> Iterator[Outcome]:
    for one in checks:
        begun = time.monotonic()
        outcome, why = _judge(stage, one)
        if outcome is Result.FAILED:
            stage.dismiss()  # the next check begins with a fresh one
        yield Outcome(one.name, one.what, one.rule, outcome, why, round(time.monotonic() - begun, 3))


def _judge(stage: Stage, one: Check) -> tuple[Result, str]:
    if not (one.still or stage.motion):
        return Result.LEFT_OUT, "it is of motion; --motion turns the arm"
    try:
        if one.needs and not stage.peer.has_function(one.needs):
            return Result.LEFT_OUT, f"its own provider has no {one.needs}"
        one.does(stage)
    except NotHeld as why:
        return Result.FAILED, str(why)
    except (TradeError, TimeoutError) as error:
        return Result.FAILED, f"{type(error).__name__}: {error}"
    except (TypeError, ValueError, LookupError, AttributeError) as error:  # its answer may have any content
        return Result.FAILED, f"its answer cannot be read: {type(error).__name__}: {error}"
    return Result.OK, ""
