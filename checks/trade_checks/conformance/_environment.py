"""The environment of the checks: a system on this host only, and control over the container under test in it."""

import contextlib
import os
import secrets
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from trade import Container, Settings
from trade.errors import ConfigurationError
from trade.protocol.keys import ALIVE, Address, is_chunk, registry_key
from trade.records import Granted, Token
from trade.transport.base import Answer, ChannelClosed
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport, configuration
from trade_checks.conformance._assertions import SLACK_S, STOPPED_S, NotHeld, eventually, require
from trade_checks.conformance._peer import Peer, end_group
from trade_checks.conformance._raw_client import NEVER, PARTING_S, SYSTEM, RawClient

IDENTITY: Final = "peer"
NAME: Final = "peer"
_START_S: Final = 30.0
_STILL_S: Final = 0.15
_LOOK_S: Final = 0.05
_LAST_LINES: Final = 12


class Stage:
    """Everything that a check needs. A context manager that leaves nothing behind."""

    def __init__(self, command: str, folder: Path, *, motion: bool) -> None:
        try:
            self._command = shlex.split(command)
        except ValueError as bad:
            raise ConfigurationError(where="--peer", problem=f"cannot be read as words: {bad}") from None
        if not self._command:
            raise ConfigurationError(where="--peer", problem="names no program. Give the command that starts it")
        if shutil.which(self._command[0]) is None:
            raise ConfigurationError(
                where="--peer", problem=f"cannot be started: there is no program {self._command[0]!r}"
            )
        self._folder = folder
        self.motion: Final = motion
        """Whether checks may turn the arm."""
        self._system = f"conformance-{secrets.token_hex(4)}"
        self._credentials = ("conformance", secrets.token_hex(16))
        self._ending = contextlib.ExitStack()
        self._signs: set[str] = set()
        self._states = 0
        self._peer: Peer | None = None
        self.container: Container
        """The suite's own container, which offers what the container under test calls."""

    def __enter__(self) -> "Stage":
        with contextlib.ExitStack() as ending:
            self._endpoint = free_endpoint()
            self._transport = ZenohTransport(
                configuration(
                    namespace=self._system, listen=[self._endpoint], connect=[], credentials=self._credentials
                )
            )
            signs = self._transport.presences(ALIVE)
            watching = threading.Thread(target=self._watch, args=(signs,), name="suite-presence", daemon=True)
            ending.callback(watching.join, PARTING_S)
            ending.callback(self._transport.close)
            ending.callback(signs.close)
            watching.start()
            settings = Settings.read(
                system=self._system,
                identity="judge",
                container="judge",
                connect=[self._endpoint],
                credentials=self._credentials,
                environment={"TRADE_STATE_DIR": str(self._folder / "judge")},
            )
            self.container = ending.enter_context(Container(settings))
            ending.callback(self.dismiss)
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._ending.close()

    # --- the container under test

    @property
    def peer(self) -> Peer:
        """The running container under test; starts it if necessary."""
        if self._peer is None or not self._peer.alive:
            self.dismiss()
            self._peer = self.start()
        return self._peer

    def environment(self) -> dict[str, str]:
        """The environment variables of the container under test, from docs/wire-protocol.md."""
        return {
            "TRADE_SYSTEM": self._system,
            "TRADE_IDENTITY": IDENTITY,
            "TRADE_CONTAINER": NAME,
            "TRADE_CONNECT": self._endpoint,
            "TRADE_CREDENTIALS": ":".join(self._credentials),
            "TRADE_STATE_DIR": str(self._folder / f"state-{self._states}"),
        }

    def start(self, *, forgetful: bool = False) -> Peer:
        """Starts the container under test, and waits for its sign of life.

        Args:
            forgetful: whether it gets a new folder for its persistent state.

        Raises:
            NotHeld: it ends, or does not appear.
            ConfigurationError: there is no such program.
        """
        self._states += forgetful
        known = set(self.boots())
        log = self._folder / "peer.log"
        try:
            with log.open("ab") as output:
                process = subprocess.Popen(  # noqa: S603 - the container under test, as configured
                    self._command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**_without_settings(os.environ), **self.environment()},
                    start_new_session=True,  # it may be a shell, or start other processes: all of them are ended
                )
        except OSError as bad:
            raise ConfigurationError(where="--peer", problem=f"cannot be started: {bad}") from None

        def seen() -> bool:
            require(process.poll() is None, f"it ended with exit code {process.returncode}: {self.last_words()}")
            return bool(set(self.boots()) - known)

        try:
            eventually(seen, f"there is no sign of life on alive/{IDENTITY}/{NAME}/...", _START_S)
            rose = set(self.boots()) - known
            require(len(rose) == 1, f"{len(rose)} signs of life appeared: {', '.join(map(str, rose))}")
            [address] = rose
            eventually(lambda: self.ask(registry_key("*", address, "*")), "it does not answer the registry query")
        except BaseException:
            end_group(process)
            raise
        self._peer = Peer(process, address, self.ask, self.seen)
        return self._peer

    def kill(self) -> Peer:
        """Kills the container under test; returns it."""
        was = self.peer
        was.signal(signal.SIGKILL)
        was.process.wait()
        eventually(lambda: not self.seen(was.address), "its sign of life remains after its end")
        self._peer = None
        return was

    def dismiss(self) -> None:
        """Ends the container under test, by force if necessary. Idempotent."""
        was, self._peer = self._peer, None
        if was is not None:
            end_group(was.process)

    def last_words(self) -> str:
        """Its last lines of output, for people."""
        log = self._folder / "peer.log"
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
        return " | ".join(lines[-_LAST_LINES:]) or "it said nothing"

    # --- observation

    def boots(self) -> list[Address]:
        """The boots of the container under test that have a sign of life."""
        found = [sign.split("/")[1:] for sign in set(self._signs)]
        return [Address(*chunks) for chunks in found if chunks[:2] == [IDENTITY, NAME] and _is_boot(chunks)]

    def seen(self, address: Address) -> bool:
        """Whether a container has a sign of life."""
        return f"alive/{address}" in self._signs

    def _watch(self, signs: Any) -> None:
        while True:
            try:
                message = signs.receive()
            except ChannelClosed:
                return
            known = set(self._signs)
            self._signs = known - {message.key} if message.payload is None else known | {message.key}

    def ask(self, pattern: str) -> list[Answer]:
        """Returns the answers to a registry query."""
        return [answer for answer in self._transport.ask([pattern], 2.0) if answer.messages]

    @contextlib.contextmanager
    def listening(self, pattern: str) -> Generator[list[Any], None, None]:
        """The messages on matching keys, in a list that grows."""
        heard: list[Any] = []
        channel = self._transport.subscribe(pattern)

        def read() -> None:
            with contextlib.suppress(ChannelClosed):
                while True:
                    heard.append(channel.receive())

        reading = threading.Thread(target=read, name="suite-listening", daemon=True)
        reading.start()
        try:
            yield heard
        finally:
            channel.close()
            reading.join(PARTING_S)

    # --- clients

    def voice(self, identity: str = "anna", *, client: str = "1") -> RawClient:
        """A client that sends it raw messages; the caller closes it."""
        return RawClient(self._transport, identity, self.peer.address, client=client, motion=self.motion)

    # --- the arm

    def angle(self, client: RawClient) -> float:
        """The angle of its arm in rad."""
        return float(client.result(self.peer.arm, "angle", expires_ns=NEVER))

    def turns(self, client: RawClient) -> int:
        """The number of turns that have begun since its boot."""
        return int(client.result(self.peer.arm, "turns", expires_ns=NEVER))

    def begin_turn(self, client: RawClient, **how: Any) -> int:
        """Starts a long turn; returns the call's id once the arm moves. Raises NotHeld if it does not."""
        away_rad = self.far_rad(client)
        call_id = client.call(self.peer.arm, "turn", away_rad, expires_ns=client.expiry_ns(60.0), **how)

        def moves() -> bool:
            for reply in client.answers(call_id):
                raise NotHeld(f"a turn did not begin, but was answered with status {reply.status}")
            return self.moves(client)

        eventually(moves, "angle() does not show the requested turn")
        return call_id

    def far_rad(self, client: RawClient) -> float:
        """An angle that takes half a minute to reach."""
        return -30.0 if self.angle(client) > 0 else 30.0

    def moves(self, client: RawClient) -> bool:
        """Whether the arm moves now."""
        before = self.angle(client)
        threading.Event().wait(_LOOK_S)
        return self.angle(client) != before

    @contextlib.contextmanager
    def stopping(self, client: RawClient, after: str) -> Generator[None, None, None]:
        """Raises NotHeld unless the arm comes to rest in time after the stop begins, and stays there.

        The stop must not wait for its answer, which may arrive after the arm has to rest.
        """
        since = time.monotonic()
        yield
        self.require_rest(client, after, since)

    def require_rest(self, client: RawClient, after: str, since: float) -> None:
        """Raises NotHeld unless the arm rests in time after that moment of time.monotonic(), and stays there."""
        limit_s, before = STOPPED_S + SLACK_S, self.angle(client)
        while True:
            took_s = time.monotonic() - since
            require(took_s < limit_s, f"the arm is not at rest within {limit_s:g} s after {after}")
            threading.Event().wait(_LOOK_S)
            where = self.angle(client)
            if where == before:
                break
            before = where
        threading.Event().wait(_STILL_S)
        require(self.angle(client) == where, f"the arm moves again after {after}, at rest for {took_s:.1f} s")

    def acquire(self, client: RawClient, resources: Sequence[str], **terms: Any) -> Any:
        """Requests a lock; returns the answer."""
        return client.ask(SYSTEM, "acquire", list(resources), terms)

    def granted(self, client: RawClient, resources: Sequence[str], **terms: Any) -> Token:
        """Takes a lock; raises NotHeld if it is not granted."""
        found = client.result(SYSTEM, "acquire", list(resources), terms)
        try:
            granted = msgspec.convert(found, Granted)
        except msgspec.ValidationError as bad:
            raise NotHeld(f"the answer of acquire cannot be read: {bad}") from None
        if granted.token is None or not set(resources) <= set(granted.resources):
            raise NotHeld(f"acquire answered {found!r}, which is not what was requested")
        return granted.token


def _is_boot(chunks: Sequence[str]) -> bool:
    return len(chunks) == 3 and all(map(is_chunk, chunks))


def _without_settings(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if not name.startswith("TRADE_") or "RUNTIME" in name}
