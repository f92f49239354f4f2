"""The WebSocket API: one client with one session, for as long as the connection lasts."""

import asyncio
from collections import defaultdict, deque
from collections.abc import Awaitable, Callable
from contextlib import nullcontext, suppress
from typing import Any, Final

import anyio
from starlette.websockets import WebSocket, WebSocketDisconnect

from trade import Handle, Run
from trade.errors import InvalidResult, LockLost, TradeError
from trade_gateway.clients import Client, ClientApi, TooMany
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._errors import BadMessage
from trade_gateway.clients._problems import problem_of
from trade_gateway.http._authentication import SUBPROTOCOL, Authenticator
from trade_gateway.http._origin_check import problem_response
from trade_gateway.http._session_timeouts import Leases

MOST_UNDER_WAY: Final = 64
"""Most calls, streams and watches of one connection; stops do not count."""
_MOST_STOPS: Final = 4
"""Concurrent stops of one service, or e-stops, of one connection; further requests share the next one."""
_MOST_ANSWERS: Final = 256
"""Most stops of one connection that wait for their answer."""
_MOST_WAITING: Final = 256
"""Most events that wait for a slow client; the oldest is dropped first."""
_SENT_WITHIN_S: Final = 2.0
"""Time limit for sending; a client that accepts nothing for so long is gone (S05)."""
_LOG_EVERY_S: Final = 0.5
_OLD_LINES: Final = 200
"""Number of earlier log lines that are sent at first."""

_ENDED: Final = 1008


class Socket:
    """The endpoint of the WebSocket."""

    def __init__(self, api: ClientApi, authenticator: Authenticator, leases: Leases) -> None:
        self._api = api
        self._authenticator = authenticator
        self._leases = leases

    async def serve(self, websocket: WebSocket) -> None:
        """Serves one connection, from its handshake to its end."""
        try:
            who = self._authenticator.who(websocket.scope)
            client = await self._api.in_thread(self._api.clients.open, who, stops=True)
        except TradeError as error:
            await websocket.send_denial_response(problem_response(error))
            return
        try:
            offered = SUBPROTOCOL in websocket.scope["subprotocols"]
            await websocket.accept(SUBPROTOCOL if offered else None)
            self._leases.begin(client, 0, lambda: self._authenticator.still(websocket.scope, who))
            await Conversation(websocket, client, self._api).run()
            with anyio.move_on_after(_SENT_WITHIN_S), suppress(WebSocketDisconnect, RuntimeError):  # it is closed
                await websocket.close(_ENDED)
        finally:
            await asyncio.shield(asyncio.ensure_future(self._api.in_thread(client.close, stops=True)))


class _Operation:
    """The operation that a message has begun."""

    def __init__(self, request: messages.Asked, handle: Handle | None, admitted: int) -> None:
        self.asked: Final = request
        self.handle: Final = handle
        """The service to call or stream."""
        self.admitted = admitted
        """The number of the client's stops before it."""
        self.scope = anyio.CancelScope()
        self.run: Run | None = None
        self.unwanted = False
        """Whether a call was cancelled, even before it began."""


class _Line:
    """Stops of one kind: a few run at once, and later requests share one that has not begun."""

    def __init__(self) -> None:
        self._places = anyio.Semaphore(_MOST_STOPS)
        self._next: asyncio.Future[Any] | None = None
        """The result of the next stop, for those that share it."""

    @property
    def idle(self) -> bool:
        """Whether no stop is running."""
        return self._next is None and self._places.value == _MOST_STOPS

    @property
    def shared(self) -> bool:
        """Whether a stop is about to begin that also counts for a request now."""
        return self._next is not None

    async def take(self, do: Callable[[], Awaitable[Any]]) -> Any:
        """Runs a stop, or shares one that has not begun yet."""
        if self._next is not None:
            return await asyncio.shield(self._next)
        shared = self._next = asyncio.get_running_loop().create_future()
        shared.add_done_callback(lambda done: done.cancelled() or done.exception())  # it may be shared by no request
        try:
            async with self._places:
                self._next = None
                shared.set_result(await do())
        except Exception as error:  # noqa: BLE001 - the result is for all requests that share it
            shared.set_exception(error)
        finally:
            if not shared.done():
                self._next = None
                shared.cancel()
        return shared.result()


class Conversation:
    """The messages of one connection."""

    def __init__(self, websocket: WebSocket, client: Client, api: ClientApi) -> None:
        self._websocket = websocket
        self._client = client
        self._api = api
        self._tasks = anyio.create_task_group()
        self._ongoing: dict[messages.Id, _Operation] = {}
        self._stops: defaultdict[object, _Line] = defaultdict(_Line)
        """For each stop service, its running stops."""
        self._speaking = anyio.Lock()
        self._beginning = anyio.Lock()
        """Keeps calls in the order of their requests: of two set-points the later one counts."""
        self._waiting: deque[dict[str, Any]] = deque(maxlen=_MOST_WAITING)
        self._missed = 0
        self._more = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        """Runs until one side closes. All its operations end with it."""
        async with self._tasks:
            self._client.when_closed(lambda: self._soon(self._tasks.cancel_scope.cancel))
            self._tasks.start_soon(self._carry)
            while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
                self._hear(message.get("text") or "")
                await asyncio.sleep(0)  # the operation begins before the next one, however many wait
            await self._end()

    async def _end(self) -> None:
        """Stops all motion first, then ends the other operations."""
        await self._apart(self._client.close)
        self._tasks.cancel_scope.cancel()

    # --- sending

    async def _say(self, message: dict[str, Any]) -> None:
        text = _text(message)
        with anyio.move_on_after(_SENT_WITHIN_S) as limit:
            async with self._speaking:
                with suppress(WebSocketDisconnect, RuntimeError):  # it is closed; the reader sees that too
                    await self._websocket.send_text(text)
        if limit.cancelled_caught:
            await self._end()

    def _post(self, message: dict[str, Any]) -> None:
        """Queues a message from any thread."""
        self._soon(self._note, message)

    def _soon(self, do: Callable[..., None], *args: Any) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(do, *args)

    def _note(self, message: dict[str, Any]) -> None:
        self._missed += len(self._waiting) == _MOST_WAITING
        self._waiting.append(message)
        self._more.set()

    async def _carry(self) -> None:
        while True:
            await self._more.wait()
            self._more.clear()
            while self._waiting:
                message, missed = self._waiting.popleft(), self._missed
                self._missed = 0
                await self._say({**message, "missed": missed} if missed else message)

    # --- receiving

    def _hear(self, text: str) -> None:
        try:
            asked: messages.Asked = messages.read(text, messages.ASKED)
        except BadMessage as bad:
            self._note({"id": None, "problem": problem_of(bad)})
            return
        try:
            ongoing = self._admitted(asked)
        except TradeError as error:
            self._api.note_refused(error)
            self._note({"id": asked.id, "problem": problem_of(error)})
            return
        self._ongoing[asked.id] = ongoing
        self._tasks.start_soon(self._do, ongoing)

    def _admitted(self, request: messages.Asked) -> _Operation:
        """Checks a request. Raises BadMessage, TooMany, NoSuchService, TooManyServices: it cannot begin."""
        if request.id in self._ongoing:
            raise BadMessage(problem=f"the operation with id {request.id!r} has not ended yet. Use another id")
        handle = None
        if isinstance(request, messages.Call | messages.Stream):
            handle = self._api.find(self._client.identity, request.group, request.name, request.container)
        stop = _stopping(request, handle)
        if len(self._ongoing) >= MOST_UNDER_WAY and stop is None:
            raise TooMany(what="calls, streams and watches of this connection", limit=MOST_UNDER_WAY)
        admitted = 0 if handle is None else self._client.admit(handle)
        if len(self._ongoing) >= _MOST_ANSWERS and stop in self._stops and self._stops[stop].shared:
            raise TooMany(
                what="stops of this connection that wait for their answer (they are executed)", limit=_MOST_ANSWERS
            )
        return _Operation(request, handle, admitted)

    async def _do(self, ongoing: _Operation) -> None:
        result, name = None, ongoing.asked.id
        try:
            with ongoing.scope:
                stop = _stopping(ongoing.asked, ongoing.handle)
                result = await (self._done(ongoing) if stop is None else self._stop(stop, ongoing))
            answer = {"id": name, "result": result}
        except Exception as error:  # noqa: BLE001 - reported to the client, whatever a provider raises
            self._api.note_refused(error)
            answer = {"id": name, "problem": problem_of(error)}
        del self._ongoing[name]
        await self._say(answer)

    async def _done(self, ongoing: _Operation) -> Any:
        match asked := ongoing.asked:
            case messages.Call():
                assert ongoing.handle is not None  # noqa: S101 - the check of the request has found it
                return await self._call(asked, ongoing.handle, ongoing)
            case messages.Stream():
                assert ongoing.handle is not None  # noqa: S101 - likewise
                return await self._stream(asked, ongoing.handle)
            case messages.Watch():
                return await self._watch(asked)
            case messages.Logs() | messages.Calls():
                return await (self._logs(asked) if isinstance(asked, messages.Logs) else self._calls(asked))
            case messages.TakeLock():
                return await self._api.lock(self._client, asked, self._lock_lost)
            case messages.Unlock():
                return {"released": await self._api.in_thread(self._client.unlock, asked.lock)}
            case messages.Resume():
                return {"resumed": await self._api.resume(self._client, asked)}
            case messages.Estop():
                return await self._api.estop(self._client.identity, asked)
            case messages.Cancel():
                return {"cancelled": await self._cancel(asked.which)}

    # --- operations

    async def _stop(self, which: object, ongoing: _Operation) -> Any:
        """Runs a stop; it counts for all requests before its start."""

        async def stop() -> Any:
            ongoing.admitted = self._client.stops
            return await self._done(ongoing)

        line = self._stops[which]
        try:
            return await line.take(stop)
        finally:
            if line.idle:
                self._stops.pop(which, None)

    async def _call(self, request: messages.Call, handle: Handle, ongoing: _Operation) -> Any:
        self._api.judge.require_unmarked(self._client.identity, handle)
        async with nullcontext() if handle.effect == "stop" else self._beginning:
            run = await self._api.begin(self._client, handle, request, ongoing.admitted)
        ongoing.run = run
        if ongoing.unwanted:
            await self._api.end(self._client, run)
        run.on_progress(lambda value: self._post({"id": request.id, "progress": value}))
        await run.settled()
        return run.result(0)

    async def _cancel(self, which: messages.Id) -> bool:
        ongoing = self._ongoing.get(which)
        if ongoing is None:
            return False
        match ongoing.asked:
            case messages.Call():
                ongoing.unwanted = True
                if ongoing.run is not None:
                    await self._api.end(self._client, ongoing.run)
            case messages.Stream() | messages.Watch() | messages.Logs() | messages.Calls():
                ongoing.scope.cancel()
            case _:
                return False
        return True

    async def _stream(self, request: messages.Stream, handle: Handle) -> None:
        samples = await self._api.stream(self._client, handle, request)
        try:
            while True:
                try:
                    sample = await samples.anext()
                    self._api.judge.require_call(self._client.identity, handle)
                except Exception as error:
                    if samples.ended or not self._api.judge.sees(self._client.identity, handle):
                        raise
                    await self._say({"id": request.id, "failed": problem_of(error)})  # this sample; others may follow
                else:
                    await self._say({"id": request.id, "sample": sample})
        finally:
            await self._apart(samples.close)

    async def _watch(self, request: messages.Watch) -> None:
        def tell(occasion: str, handle: Handle) -> None:
            view = self._api.view(self._client.identity, handle)
            self._post({"id": request.id, "event": occasion, "service": view})

        standing = await self._api.in_thread(self._api.watch, self._client, request, tell)
        try:
            await anyio.sleep_forever()
        finally:
            for one in standing:
                await self._apart(one.cancel)

    async def _logs(self, request: messages.Logs) -> None:
        reader = self._api.overview.log()
        lines = await self._api.overview.log_lines(self._client.identity, reader)
        lines = lines[-_OLD_LINES:]
        while True:
            for line in lines:
                if line.level >= request.level:
                    await self._say({"id": request.id, "line": line})
            await anyio.sleep(_LOG_EVERY_S)
            lines = await self._api.overview.log_lines(self._client.identity, reader)

    async def _calls(self, request: messages.Calls) -> None:
        reader = self._api.overview.ended(reads=request.reads)
        while True:
            for span in await self._api.overview.calls(self._client.identity, reader):
                await self._say({"id": request.id, "call": messages.call_view(span)})
            await anyio.sleep(_LOG_EVERY_S)

    async def _apart(self, close: Callable[[], object]) -> None:
        with anyio.CancelScope(shield=True):
            await self._api.in_thread(close, stops=True)

    def _lock_lost(self, lock: str, error: LockLost) -> None:
        self._post({"event": "lock_lost", "lock": lock, "problem": problem_of(error)})


def _stopping(request: messages.Asked, handle: Handle | None) -> object:
    """The key of a requested stop; None for other requests."""
    match request:
        case messages.Estop():
            return "estop"
        case messages.Cancel():
            return "cancel", request.which
        case _:
            return handle.key if handle is not None and handle.effect == "stop" else None


def _text(message: dict[str, Any]) -> str:
    try:
        return messages.encoder.encode(message).decode()
    except messages.NO_JSON as bad:
        what = "problem" if "result" in message else "failed"
        wrong = InvalidResult(service=str(message["id"]), problem=f"it cannot be expressed in JSON: {bad}")
        return messages.encoder.encode({"id": message["id"], what: problem_of(wrong)}).decode()
