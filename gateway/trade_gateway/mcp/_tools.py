"""The tools of an agent: queries within its rights, and motion under its locks."""

import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Annotated, Any, Final, NamedTuple

import anyio
import msgspec
from anyio.to_thread import run_sync
from msgspec import Meta, Struct

from trade import Container, Handle
from trade.errors import LockLost, NoSuchService, TradeError
from trade_gateway.clients import Client, ClientApi
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._errors import NeedsLock, NoSuchTool, NoTwin, WrongTool
from trade_gateway.language import Dialogue, Lexicon, Memory
from trade_gateway.mcp._approvals import Approvals
from trade_gateway.mcp._simulation_twin import Twin, TwinResult

Progress = Callable[[Any], None]
"""Receives the progress of a call; on any thread."""
_APPROVED_WITHIN_S: Final = 120.0
_STOPS_WITHIN_S: Final = 10.0
_TRIED_WITHIN_S: Final = 120.0
_TEXT: Final = Meta(max_length=500)


class Find(Struct, forbid_unknown_fields=True, kw_only=True):
    group: str = ""
    """This group and those beneath it: ``rosie.head``. Empty: all."""
    name: str = ""
    """``*`` and ``?`` are wildcards."""
    needs: str = ""
    """A predicate that one of its pre-conditions fits: ``see(?x)``."""
    achieves: str = ""
    """A predicate that one of its post-conditions fits."""


class ServiceArguments(Struct, forbid_unknown_fields=True, kw_only=True):
    group: messages.Group
    name: Annotated[str, Meta(min_length=1)]
    container: str = ""
    """Only the service of this container."""


class CallArguments(messages.CallBody, forbid_unknown_fields=True, kw_only=True):
    group: messages.Group
    name: Annotated[str, Meta(min_length=1)]
    why: Annotated[str, _TEXT] = ""
    """For the person who may have to approve it."""


class Sentence(Struct, forbid_unknown_fields=True, kw_only=True):
    sentence: Annotated[str, Meta(min_length=1, max_length=500)]


class LockArgs(Struct, forbid_unknown_fields=True, kw_only=True):
    lock: str
    """The name that the tool ``lock`` returned."""


class NoArgs(Struct, forbid_unknown_fields=True):
    pass


class ServiceDescription(Struct, frozen=True):
    """A service with the JSON Schemas of its arguments and result."""

    service: messages.ServiceView
    arguments: Mapping[str, Any]
    result: Mapping[str, Any]
    needs_lock: bool
    needs_approval: bool


class Tools:
    """The tools of one agent; it is a client with its own session, which ends with it.

    Args:
        container: the container that acts for the agent.
        api: the operations of clients.
        client: the agent.
        approvals: human approval of calls.
        lexicon: the known sentences.
        twin: the simulated twin for dry runs; None: there is none.
    """

    def __init__(
        self,
        container: Container,
        api: ClientApi,
        client: Client,
        approvals: Approvals,
        lexicon: Lexicon,
        twin: Twin | None = None,
    ) -> None:
        self._container = container
        self._api = api
        self._client = client
        self._approvals = approvals
        self._twin = twin
        self._talk = Dialogue(container, lexicon, Memory())
        self._trying = anyio.CapacityLimiter(1)
        self._lost: list[str] = []

    async def use(self, name: str, given: Any, progress: Progress = lambda _: None) -> Any:
        """Runs a tool, and audits that if an audit record is kept.

        Raises:
            NoSuchTool: there is no tool of that name.
            WrongTool: its arguments are wrong.
            TradeError: the operation failed; also any exception of a provider.
        """
        tool = TOOLS.get(name)
        if tool is None:
            raise NoSuchTool(name=name, known=tuple(TOOLS))
        began, about = time.monotonic_ns(), ""
        try:
            try:
                asked = msgspec.convert(messages.numbers(given), tool.asked)
            except (msgspec.ValidationError, ValueError) as bad:
                raise WrongTool(problem=f"the arguments of {name} are wrong: {bad}") from None
            about = _about(asked)
            result = await tool.do(self, asked, progress)
        except Exception as error:
            self.record(name, about, began, type(error).__name__, str(error) if isinstance(error, TradeError) else "")
            raise
        self.record(name, about, began, "ok", "")
        return result

    def record(self, tool: str, about: str, began: int, outcome: str, reason: str) -> None:
        """Audits the use of a tool that began at this ``time.monotonic_ns()``."""
        took_ns = time.monotonic_ns() - began
        what, who = f"agent's tool {tool}", self._client.identity
        self._container.note_request(what, about, client=who, outcome=outcome, error=reason, took_ns=took_ns)

    # --- queries

    async def services(self, request: Find, _: Progress) -> Any:
        """List services: what they do, need, achieve and use, their health, and whether they may be called."""
        found = self._api.seen(self._client.identity, request.group, request.name, request.needs, request.achieves)
        return [self._api.view(self._client.identity, handle) for handle in found]

    async def describe(self, request: ServiceArguments, _: Progress) -> Any:
        """Describe one service: JSON Schemas of its arguments and result, and what a call of it needs."""
        handle = self._find(request.group, request.name, request.container)
        schema = handle.schema
        return ServiceDescription(
            self._api.view(self._client.identity, handle),
            schema["arguments"],
            schema["result"],
            needs_lock=handle.effect == "actuate",
            needs_approval=self._approvals.needed(self._client.identity, handle),
        )

    async def ask(self, request: Sentence, _: Progress) -> Any:
        """Answer a question about the system in plain English: what runs where, lock owners, failures, changes.

        It changes nothing: to stop, use the tools `stop` and `estop`.
        """
        who = self._client.identity
        if who != self._container.address.identity:  # the answer is all that the container may know
            self._api.judge.require_system(who, "read", "ask")
        return await self._api.counted(who, partial(self._talk.say, request.sentence, orders=False))

    async def locks(self, _asked: NoArgs, _: Progress) -> Any:
        """List all locks, and those of this agent that were lost since it last asked."""
        lost, self._lost = self._lost, []
        return {"locks": await self._api.locks(self._client.identity), "lost": lost}

    # --- actions

    async def lock(self, request: messages.LockBody, _: Progress) -> Any:
        """Take a lock over all that a group uses: rosie.head. No other client can move it until you release it."""
        return await self._api.lock(self._client, request, self._lock_lost)

    async def unlock(self, request: LockArgs, _: Progress) -> Any:
        """Release a lock; motion under it stops."""
        return {"released": await self._api.in_thread(self._client.unlock, request.lock)}

    async def call(self, request: CallArguments, progress: Progress) -> Any:
        """Call a service and wait for its end. What moves something needs a lock, and perhaps a person's approval."""
        handle = self._find(request.group, request.name, request.container)
        self._require_lock(handle)
        self._api.judge.require_call(self._client.identity, handle)
        admitted = self._client.admit(handle)
        if self._approvals.needed(self._client.identity, handle):
            progress("waits for a person's approval")
            await self._approvals.ask(self._client.identity, handle, request.args, request.why, _APPROVED_WITHIN_S)
            self._require_lock(handle)
        run = await self._api.begin(self._client, handle, request, admitted)
        run.on_progress(progress)
        try:
            await run.settled()
        finally:
            if not run.done():  # the agent has cancelled it, or is gone
                with anyio.CancelScope(shield=True):
                    await self._api.end(self._client, run)
        return {"result": run.result(0)}

    async def try_on_twin(self, request: CallArguments, _: Progress) -> Any:
        """Try a call on a simulated twin, brought to where the whole robot is. Nothing real moves."""
        if self._twin is None:
            raise NoTwin(reason="this server has no twin")
        handle = self._find(request.group, request.name, request.container)
        states = await self._states_of(handle.key.domain.partition(".")[0])
        trying = partial(self._twin.call, handle, request.args, min(request.deadline_s, _TRIED_WITHIN_S), states)
        tried: TwinResult = await run_sync(trying, abandon_on_cancel=True, limiter=self._trying)
        return tried  # nothing of the real robot waits for it

    async def stop(self, request: messages.GroupBody, _: Progress) -> Any:
        """Stop all motion in a group, by any client. Needs no lock and no right."""
        who = self._client.identity
        stops = [one for one in self._api.seen(who, request.group) if one.effect == "stop"]
        if not stops:
            raise NoSuchService(constraint=f"stop in {request.group}")
        results: dict[str, str] = {}

        async def stop(handle: Handle) -> None:
            try:
                body = messages.CallBody(deadline_s=_STOPS_WITHIN_S)
                run = await self._api.begin(self._client, handle, body, self._client.admit(handle))
                await run.settled()
                run.result(0)
                results[handle.label] = "stopped"
            except Exception as error:  # noqa: BLE001 - the other stops must still run
                results[handle.label] = f"{type(error).__name__}: {error}"

        async with anyio.create_task_group() as tasks:
            for handle in stops:
                tasks.start_soon(stop, handle)
        return results

    async def estop(self, request: messages.EstopBody, _: Progress) -> Any:
        """Stop everything in the whole system. A person has to clear it. Not safety-rated."""
        return await self._api.estop(self._client.identity, request)

    # --- helpers

    def _find(self, group: str, name: str, container: str) -> Handle:
        return self._api.find(self._client.identity, group, name, container)

    def _require_lock(self, handle: Handle) -> None:
        if handle.effect == "actuate" and not self._client.has_locked(handle):
            raise NeedsLock(service=handle.label, resources=handle.resources or (handle.label,))

    async def _states_of(self, robot: str) -> dict[str, Any]:
        """The ``state`` of each group of a robot; None where it could not be read."""
        readers = self._api.seen(self._client.identity, robot, "state")
        return {one.key.domain: await self._read(one) for one in readers if one.effect == "read"}

    async def _read(self, reader: Handle) -> Any:
        try:
            run = await self._api.begin(self._client, reader, messages.CallBody(), self._client.admit(reader))
            await run.settled()
            return run.result(0)
        except TradeError:
            return None

    def _lock_lost(self, name: str, error: LockLost) -> None:
        self._lost.append(f"{name}: {error}")


class Tool(NamedTuple):
    """The description of one tool."""

    asked: type[Struct]
    do: Callable[..., Awaitable[Any]]
    reads: bool = False
    """Whether it changes nothing."""

    @property
    def text(self) -> str:
        """Its description."""
        return self.do.__doc__ or ""

    @property
    def schema(self) -> dict[str, Any]:
        """JSON Schema of its arguments, without references."""
        [schema], parts = msgspec.json.schema_components([self.asked])
        return {key: value for key, value in parts[schema["$ref"].rpartition("/")[2]].items() if key != "title"}


TOOLS: Final = {
    "services": Tool(Find, Tools.services, reads=True),
    "describe": Tool(ServiceArguments, Tools.describe, reads=True),
    "ask": Tool(Sentence, Tools.ask, reads=True),
    "locks": Tool(NoArgs, Tools.locks, reads=True),
    "lock": Tool(messages.LockBody, Tools.lock),
    "unlock": Tool(LockArgs, Tools.unlock),
    "call": Tool(CallArguments, Tools.call),
    "dry_run": Tool(CallArguments, Tools.try_on_twin, reads=True),
    "stop": Tool(messages.GroupBody, Tools.stop),
    "estop": Tool(messages.EstopBody, Tools.estop),
}
"""By name."""


def _about(request: Struct) -> str:
    """The target of a request, without its arguments, which may be confidential."""
    group, name = getattr(request, "group", ""), getattr(request, "name", "")
    return ".".join(filter(None, (group, name))) or getattr(request, "sentence", "") or getattr(request, "lock", "")
