"""Starts containers on other hosts, through the ``ssh`` program of this host."""

import contextlib
import re
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from trade._context.call_context import patience_s
from trade.command_output import as_text
from trade.errors import CannotStart, ConfigurationError, StartFailure

CONNECT_S: Final = 10
LONGEST_S: Final = 60.0
_END_S: Final = 2.0 * CONNECT_S
"""The timeout of an end in seconds, whatever time is left for the call that started the container."""
_ASKED: Final = ("-o", "BatchMode=yes", "-o", "StrictHostKeyChecking=yes", "-o", f"ConnectTimeout={CONNECT_S}", "-T")
"""ssh prompts for nothing, and accepts only host keys that are known."""
_HOST: Final = re.compile(r"(?:[A-Za-z0-9_][\w.+-]*@)?[A-Za-z0-9_\[][\w.:%\]-]*")
_VARIABLE: Final = re.compile(r"[A-Za-z_]\w*")
_SSH_FAILED: Final = 255
_NOT_FOUND: Final = frozenset((126, 127))
_REASONS: Final[Sequence[tuple[re.Pattern[str], StartFailure, str]]] = (
    (
        re.compile(r"REMOTE HOST IDENTIFICATION HAS CHANGED|Host key for .* has changed"),
        "changed host key",
        (
            "its key differs from the one in known_hosts, so an attacker may be in between. Was it installed again? "
            "Compare the fingerprint there, then run `ssh-keygen -R HOST` and add the new key"
        ),
    ),
    (
        re.compile(r"Host key verification failed|host key is known for|No .* host key is known"),
        "unknown host key",
        (
            "compare its fingerprint on the host itself (`ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub`), then "
            "add the key to known_hosts, for example with one `ssh HOST` by hand"
        ),
    ),
    (
        re.compile(r"Permission denied|Too many authentication failures"),
        "not let in",
        "put a public key of this user into ~/.ssh/authorized_keys there; no password is asked for",
    ),
    (
        re.compile(r"Connection refused"),
        "refused",
        "no sshd listens there: start it, or name its port in ~/.ssh/config",
    ),
    (
        re.compile(r"timed out|No route to host|Network is unreachable"),
        "timeout",
        "is the host up, and does its network let port 22 through?",
    ),
    (
        re.compile(r"Could not resolve hostname"),
        "unknown host",
        "is the name right? ~/.ssh/config can give it an address",
    ),
)


_END: Final = """
args=$(2>/dev/null </proc/"$1"/cmdline tr '\\0' ' ' || ps -o args= -p "$1")
case "$args" in *"$2"*) kill "$1";; *) exit 1;; esac
"""
"""Ends a process if its command line has these words: where the container runs, processes may have other numbers."""


class Started(msgspec.Struct, frozen=True):
    """What ``trade container --detach --json`` prints when the container is up."""

    container: str
    epoch: str
    pid: int


Info = TypeVar("Info")


def start(
    host: str,
    name: str,
    *,
    system: str,
    joined: Callable[[Started], Info | None],
    wait_s: float,
    allow: Sequence[str] = (),
    connect: Sequence[str] = (),
    command: Sequence[str] = ("trade",),
    environment: Mapping[str, str] | None = None,
    ssh_config: Path | None = None,
) -> Info:
    """See `System.start_container`. Returns what ``joined`` found; without that, the container is ended again."""
    dialled = [word for endpoint in connect for word in ("--connect", endpoint)]
    allowed = [word for pattern in allow for word in ("--allow", pattern)]
    words = ["--system", system, *dialled, "container", "--name", name, *allowed]
    started = launch(host, name, words, command=command, environment=environment, ssh_config=ssh_config)
    try:
        found = joined(started)
    except BaseException:
        _give_up(host, name, started.pid, words, ssh_config)
        raise
    if found is not None:
        return found
    outcome, hint = _give_up(host, name, started.pid, words, ssh_config)
    output = f"it came up there as process {started.pid}, was not visible here within {wait_s:g} s, and {outcome}"
    remedy = f"{hint}set its endpoints (connect=...), and give it the credentials or certificates of this system"
    raise CannotStart(host=host, container=name, reason="not seen", output=output, remedy=remedy)


def _give_up(host: str, name: str, pid: int, words: Sequence[str], ssh_config: Path | None) -> tuple[str, str]:
    """End a container that did not join; returns the outcome, and what is left to do."""
    try:
        if end_there(host, name, pid, words, ssh_config):
            return "was ended again", ""
    except CannotStart:
        return "could not be ended", f"it still runs there; to end it: `ssh {host} kill {pid}`. Then "
    return "was not found there to be ended", f"look for it: `ssh {host} pgrep -af {name}`. Then "


def launch(
    host: str,
    name: str,
    words: Sequence[str],
    *,
    command: Sequence[str] = ("trade",),
    environment: Mapping[str, str] | None = None,
    ssh_config: Path | None = None,
) -> Started:
    """Run ``trade WORDS --detach`` on another host; returns when that reports that the container is up.

    Raises:
        CannotStart: with the reason and the remedy.
        ConfigurationError: an invalid host or variable.
    """
    there = [*_assigned(environment or {}), *command, *words, "--detach", "--json"]
    return _read(host, name, command[0], there, _run(host, name, ssh_words(host, ssh_config, there)))


def missing_there(
    host: str, name: str, command: Sequence[str], files: Sequence[str], ssh_config: Path | None
) -> list[str]:
    """The files that the host does not have, or that this user may not read there.

    Raises:
        CannotStart: the host, or ``trade`` on it, is unreachable.
        ConfigurationError: an invalid host.
    """
    script = f'{shlex.join(command)} --version >&2 && for one; do [ -r "$one" ] || echo "$one"; done'
    words = ["sh", "-c", script, "sh", *files]
    ended = _run(host, name, ssh_words(host, ssh_config, words))
    if ended.returncode != 0:
        raise _refusal(host, name, command[0], words, ended)
    missing = ended.stdout.splitlines()  # and any output of its shell
    return [file for file in files if file in missing]


def end_there(host: str, name: str, pid: int, words: Sequence[str], ssh_config: Path | None) -> bool:
    """Shut down a process that was started there with ``trade WORDS``, and is not in the system.

    Returns:
        Whether it got SIGTERM; False: that process is gone, or has another command line.

    Raises:
        CannotStart: ssh fails.
    """
    asked = ["sh", "-c", _END, "sh", str(pid), " ".join(words)]
    ended = _run(host, name, ssh_words(host, ssh_config, asked), longest_s=_END_S)
    if ended.returncode == _SSH_FAILED:
        raise _refusal(host, name, asked[0], asked, ended)
    return ended.returncode == 0


def _assigned(environment: Mapping[str, str]) -> list[str]:
    for variable in environment:
        if not _VARIABLE.fullmatch(variable):
            raise ConfigurationError(where="start_container", problem=f"{variable!r} is no name of a variable")
    return ["env", *(f"{key}={value}" for key, value in environment.items())] if environment else []


def ssh_words(host: str, ssh_config: Path | None, words: Sequence[str]) -> list[str]:
    """The command line that runs these words on a host; raises ConfigurationError for an invalid host."""
    if not _HOST.fullmatch(host):
        raise ConfigurationError(where="start_container", problem=f"{host!r} is no host; use HOST or USER@HOST")
    config = () if ssh_config is None else ("-F", str(ssh_config))
    return ["ssh", *config, *_ASKED, "--", host, shlex.join(words)]


def _run(
    host: str, name: str, words: Sequence[str], longest_s: float | None = None
) -> "subprocess.CompletedProcess[str]":
    longest_s = patience_s(LONGEST_S) if longest_s is None else longest_s
    try:
        return subprocess.run(  # noqa: S603 - the host is checked, and the words are quoted for its shell
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=longest_s,
            check=False,
            start_new_session=True,  # Ctrl-C goes to this program, which reports the outcome
        )
    except FileNotFoundError:
        remedy = "install it (Debian: apt-get install openssh-client)"
        raise CannotStart(host=host, container=name, reason="no ssh here", output="", remedy=remedy) from None
    except subprocess.TimeoutExpired:
        output = f"not finished within {longest_s:.3g} s"
        remedy = f"it may still come up there: `trade containers` shows it, or `ssh {host} pgrep -af {name}`"
        raise CannotStart(host=host, container=name, reason="timeout", output=output, remedy=remedy) from None


def _read(
    host: str, name: str, command: str, words: Sequence[str], ended: "subprocess.CompletedProcess[str]"
) -> Started:
    if ended.returncode != 0:
        raise _refusal(host, name, command, words, ended)
    for line in reversed(ended.stdout.splitlines()):
        with contextlib.suppress(msgspec.DecodeError):  # output of its shell
            return msgspec.json.decode(line, type=Started)
    remedy = (
        f"it said {ended.stdout[-200:]!r}, and may run there: `ssh {host} pgrep -af {name}` shows it. Does "
        f"{command!r} there start this version of trade?"
    )
    raise CannotStart(host=host, container=name, reason="no answer", output=_complaint(ended), remedy=remedy)


def _refusal(
    host: str, name: str, command: str, words: Sequence[str], ended: "subprocess.CompletedProcess[str]"
) -> CannotStart:
    reason: StartFailure = "ssh failed"
    remedy = f"try `ssh {host} true`"
    if ended.returncode == _SSH_FAILED:
        known = next((row for row in _REASONS if row[0].search(ended.stderr)), None)
        if known is not None:
            _, reason, remedy = known
    elif ended.returncode in _NOT_FOUND:
        reason = "no trade there"
        remedy = f"{command!r} is not found by its shell; install trade-gateway there, or give the path of its `trade`"
    else:
        reason, remedy = "it did not come up", f"try `ssh {host} {shlex.join(words)}`"
    return CannotStart(host=host, container=name, reason=reason, output=_complaint(ended), remedy=remedy)


def _complaint(ended: "subprocess.CompletedProcess[str]") -> str:
    return " ".join(as_text(ended.stderr).split())[-500:]
