"""``trade lock GROUP -- COMMAND``: runs a program under a lock, with which its calls are made."""

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand

from trade import Constraint
from trade.errors import LockLost
from trade_gateway._usage import UsageError, asked_for
from trade_gateway.terminal._completion import groups
from trade_gateway.terminal._options import SELECT, TIMING
from trade_gateway.terminal._system_choice import SystemChoice, choice_of, visitor_among_others

_COMMAND: Final = "trade_gateway.command"
_KILLED_BY: Final = 128
"""What shells add to the number of the signal that ended a program."""


class WithCommand(TyperCommand):
    """A command that wraps another one, which follows ``--`` and is not parsed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Keeps the words after ``--`` as the command to run."""
        cut = args.index("--") if "--" in args else len(args)
        ctx.meta[_COMMAND] = args[cut + 1 :]
        return super().parse_args(ctx, args[:cut])

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Returns the usage line."""
        return [*super().collect_usage_pieces(ctx), "-- COMMAND [ARGUMENT]..."]


COMMAND: Final = {"cls": WithCommand}
"""How the command line registers it."""


def lock(
    context: typer.Context,
    group: Annotated[
        str | None, typer.Argument(autocompletion=groups, help="Group to lock, with the groups beneath it: rosie.head.")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel=SELECT, help="Lock only services of this name; * and ? are wildcards. Repeatable."
        ),
    ] = None,
    purpose: Annotated[str | None, typer.Option(help="Purpose, shown to other clients. Default: the command.")] = None,
    wait: Annotated[
        float,
        typer.Option(
            min=0.0,
            rich_help_panel=TIMING,
            metavar="SECONDS",
            help="Time to wait for owners and missing services, in seconds.",
        ),
    ] = 10.0,
    lease: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=60.0,
            rich_help_panel=TIMING,
            metavar="SECONDS",
            help="Time that the lock survives if this command dies, in seconds.",
        ),
    ] = 2.0,
    priority: Annotated[int, typer.Option(help="Priority while waiting; the highest comes first.")] = 0,
    partial: Annotated[
        bool, typer.Option("--partial", rich_help_panel=SELECT, help="Lock even if members of the group are missing.")
    ] = False,
) -> None:
    """Run a command under a lock on these services; end with its exit code.

    The calls of the command, and of programs that it starts, are made under the lock.

    If the lock is lost, the command gets SIGTERM, its calls are refused, and the exit code is 1.

    For example: trade lock rosie.head --purpose "look around" -- python look.py
    """
    command: list[str] = context.meta[_COMMAND]
    if not command:
        raise UsageError(where="trade lock", problem="say what to run: trade lock rosie.head -- python look.py")
    wanted = _wanted(group, name or [])
    running = _LockedCommand(command)
    with visitor_among_others(context) as container:
        held = container.lock(
            wanted,
            purpose=shlex.join(command) if purpose is None else purpose,
            wait_s=wait,
            lease_s=lease,
            priority=priority,
            partial=partial,
            on_lost=running.lost,
        ).acquire()
        try:
            code = running.run({**os.environ, **_chosen(choice_of(context)), **held.environment()})
        finally:
            held.release()
    raise typer.Exit(code)


def _wanted(group: str | None, names: Sequence[str]) -> Constraint:
    if group is None and not names:
        raise UsageError(where="trade lock", problem="say what to lock: a group such as rosie.head, or --name")
    what = f"lock {group or ' '.join(names)}"
    first, *others = [asked_for(what, group=group, name=name) for name in names or [None]]
    for other in others:
        first = first | other
    return first


def _chosen(choice: SystemChoice) -> dict[str, str]:
    """Returns the choice of system as environment variables for the command."""
    connect = {"TRADE_CONNECT": ",".join(choice.connect)} if choice.connect else {}
    return {**({"TRADE_SYSTEM": choice.system} if choice.system else {}), **connect}


class _LockedCommand:
    """The command's process, and the signals that are forwarded to it."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._lost: LockLost | None = None

    def run(self, environment: dict[str, str]) -> int:
        """Runs it to its end; returns its exit code, or 1 if the lock was lost meanwhile."""
        with self._signals():
            try:
                self._process = subprocess.Popen(self._command, env=environment)  # noqa: S603 - it is what was asked for
            except OSError as bad:
                raise UsageError(where=self._command[0], problem=f"cannot be run: {bad.strerror}") from None
            if self._lost is not None:  # in between
                self._process.terminate()
            code = self._process.wait()
        if self._lost is not None:
            return 1
        return code if code >= 0 else _KILLED_BY - code

    def lost(self, error: LockLost) -> None:
        """Ends the command because its lock was lost."""
        self._lost = error  # the core's log says so on standard error
        if self._process is not None:
            self._process.terminate()

    @contextmanager
    def _signals(self) -> Generator[None]:
        """Forwards signals that would end this process to the command; this process ends with it."""
        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        before = {number: signal.signal(number, self._pass_on) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _pass_on(self, number: int, _frame: FrameType | None) -> None:
        if self._process is not None and not (number == signal.SIGINT and _in_foreground()):
            self._process.send_signal(number)


def _in_foreground() -> bool:
    """Whether the terminal itself sends Ctrl-C to the command."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (AttributeError, OSError, ValueError):  # another operating system, or no terminal
        return False
