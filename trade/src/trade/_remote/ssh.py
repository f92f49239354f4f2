"""Starts containers on other hosts, through the ``ssh`` program of this host."""

import re
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from trade._context.call_context import patience_s
from trade._remote.error_output import as_text
from trade.errors import CannotStart, ConfigurationError, StartFailure

CONNECT_S: Final = 10
LONGEST_S: Final = 60.0
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


class Started(msgspec.Struct, frozen=True):
    """What ``trade container --detach --json`` prints when the container is up."""

    container: str
    epoch: str
    pid: int


def start(
    host: str,
    name: str,
    *,
    system: str,
    allow: Sequence[str] = (),
    connect: Sequence[str] = (),
    command: Sequence[str] = ("trade",),
    environment: Mapping[str, str] | None = None,
    ssh_config: Path | None = None,
) -> Started:
    """See `System.start_container`. Returns when the container is up."""
    dialled = [word for endpoint in connect for word in ("--connect", endpoint)]
    allowed = [word for pattern in allow for word in ("--allow", pattern)]
    words = ["--system", system, *dialled, "container", "--name", name, *allowed]
    return launch(host, name, words, command=command, environment=environment, ssh_config=ssh_config)


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


def end_there(host: str, name: str, pid: int, ssh_config: Path | None) -> None:
    """Shut down a process that was started there and is not in the system. Raises CannotStart if ssh fails."""
    words = ["kill", str(pid)]
    ended = _run(host, name, ssh_words(host, ssh_config, words))
    if ended.returncode == _SSH_FAILED:
        raise _refusal(host, name, words[0], words, ended)


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


def _run(host: str, name: str, words: Sequence[str]) -> "subprocess.CompletedProcess[str]":
    longest_s = patience_s(LONGEST_S)
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
        raise CannotStart(host=host, container=name, reason="no ssh here", said="", remedy=remedy) from None
    except subprocess.TimeoutExpired:
        said, remedy = f"not finished within {longest_s:.3g} s", "check whether it is up: `trade containers`"
        raise CannotStart(host=host, container=name, reason="timeout", said=said, remedy=remedy) from None


def _read(
    host: str, name: str, command: str, words: Sequence[str], ended: "subprocess.CompletedProcess[str]"
) -> Started:
    if ended.returncode != 0:
        raise _refusal(host, name, command, words, ended)
    try:
        return msgspec.json.decode(ended.stdout.strip().splitlines()[-1], type=Started)
    except (msgspec.DecodeError, IndexError):
        remedy = f"it said {ended.stdout[-200:]!r}. Does its shell print something by itself?"
        raise CannotStart(
            host=host, container=name, reason="no answer", said=_complaint(ended), remedy=remedy
        ) from None


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
    return CannotStart(host=host, container=name, reason=reason, said=_complaint(ended), remedy=remedy)


def _complaint(ended: "subprocess.CompletedProcess[str]") -> str:
    return " ".join(as_text(ended.stderr).split())[-500:]
