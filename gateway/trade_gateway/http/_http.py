"""The HTTP API: each request has its own session, or names one that was opened before."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, Final, TypeVar

import msgspec
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from trade.errors import InvalidResult, LockLost, TooLarge, TradeError
from trade_gateway.clients import Client, ClientApi, NoSuchSession
from trade_gateway.clients import _changes as changes
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._errors import BadMessage, HttpError, NeedsSession, NotAuthenticated
from trade_gateway.http._authentication import Authenticator
from trade_gateway.http._openapi import document
from trade_gateway.http._origin_check import problem_response
from trade_gateway.http._session_timeouts import Leases

MOST_BODY_BYTES: Final = 1 << 20
SESSION: Final = "Trade-Session"
_BODY_S: Final = 10.0
"""How long a body may take to arrive, in seconds."""

Body = TypeVar("Body")
Answer = Callable[[Request], Awaitable[Response]]


class Http:
    """The routes of the HTTP API."""

    def __init__(self, api: ClientApi, authenticator: Authenticator, leases: Leases) -> None:
        self._api = api
        self._authenticator = authenticator
        self._leases = leases
        self._changes = api.administration
        self._files = api.configuration

    def routes(self) -> list[Route]:
        """Returns all routes, for an application."""
        return [
            self._route("/openapi.json", GET=self.openapi),
            self._route("/services", "group", "name", "needs", "achieves", GET=self.services),
            self._route("/me", GET=self.me),
            self._route("/containers", GET=self.containers),
            self._route("/sight", GET=self.reachability),
            self._route("/loads", GET=self.loads),
            self._route("/system", GET=self.system),
            self._route("/containers/{container}/restart", POST=self.restart),
            self._route("/containers/{container}/end", POST=self.end),
            self._route("/containers/{container}/discovery", POST=self.discovery),
            self._route("/containers/{container}/broadcast", POST=self.broadcast),
            self._route("/migrate", POST=self.migrate),
            self._route("/instantiate", POST=self.instantiate),
            self._route("/terminate", POST=self.terminate),
            self._route("/notifications", GET=self.notifications),
            self._route("/notifications/{id}", DELETE=self.cancel_notification),
            self._route("/hooks", GET=self.hooks),
            self._route("/hooks/{id}", DELETE=self.detach_hook),
            self._route("/policy", GET=self.policy),
            self._route("/policy/file", GET=self.policy_file, PUT=self.save_policy),
            self._route("/policy/test", POST=self.try_policy),
            self._route("/rules", GET=self.rule_files),
            self._route("/rules/{container}", PUT=self.save_rules),
            self._route("/rules/{container}/test", POST=self.try_rules),
            self._route("/audit", GET=self.audit),
            self._route("/tracing", POST=self.tracing),
            self._route("/call/{group}/{name}", POST=self.call),
            self._route("/session", POST=self.open_session, GET=self.session, DELETE=self.close_session),
            self._route("/locks", GET=self.locks, POST=self.lock),
            self._route("/locks/request", POST=self.request_release),
            self._route("/locks/break", POST=self.break_locks),
            self._route("/locks/{lock}", DELETE=self.unlock),
            self._route("/resume", POST=self.resume),
            self._route("/estops", GET=self.estops),
            self._route("/estop", POST=self.estop),
            self._route("/estop/clear", POST=self.clear),
        ]

    def _route(self, path: str, *query: str, **by_method: Answer) -> Route:
        async def answer(request: Request) -> Response:
            method = "GET" if request.method == "HEAD" else request.method
            asked = [name for name, _ in request.query_params.multi_items()]
            try:
                if unknown := sorted({name for name in asked if name not in query or asked.count(name) > 1}):
                    raise BadMessage(problem=f"{', '.join(unknown)}: not a parameter here, or repeated")
                return await by_method[method](request)
            except TradeError as error:
                self._api.note_refused(error)
                return refusal(error)

        return Route(path, answer, methods=list(by_method))

    # --- queries

    async def openapi(self, request: Request) -> Response:
        return _answer(document(self._api.seen(self._who(request))))

    async def services(self, request: Request) -> Response:
        who = self._who(request)
        found = self._api.seen(who, **request.query_params)
        return _answer([self._api.view(who, handle) for handle in found])

    async def me(self, request: Request) -> Response:
        return _answer(self._api.overview.me(self._who(request)))

    async def loads(self, request: Request) -> Response:
        return _answer(await self._api.overview.loads(self._who(request)))

    async def notifications(self, request: Request) -> Response:
        return _answer(await self._api.overview.notifications(self._who(request)))

    async def hooks(self, request: Request) -> Response:
        return _answer(await self._api.overview.hooks(self._who(request)))

    async def policy(self, request: Request) -> Response:
        return _answer(self._api.overview.policy(self._who(request)))

    async def audit(self, request: Request) -> Response:
        return _answer(await self._api.overview.audit(self._who(request)))

    async def tracing(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.SwitchBody)
        return _answer({"containers": await self._api.overview.set_tracing(who, on=body.on)})

    async def containers(self, request: Request) -> Response:
        return _answer(self._api.overview.containers(self._who(request)))

    async def reachability(self, request: Request) -> Response:
        return _answer(await self._api.overview.reachability(self._who(request)))

    # --- changes of the system

    async def system(self, request: Request) -> Response:
        return _answer(await self._changes.system(self._who(request)))

    async def restart(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, changes.ReasonBody)
        return _answer(await self._changes.restart(who, request.path_params["container"], body))

    async def end(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, changes.ReasonBody)
        return _answer(await self._changes.end(who, request.path_params["container"], body))

    async def discovery(self, request: Request) -> Response:
        return await self._switch(request, "discovery")

    async def broadcast(self, request: Request) -> Response:
        return await self._switch(request, "broadcast")

    async def _switch(self, request: Request, what: str) -> Response:
        who, body = self._who(request), await _body(request, messages.SwitchBody)
        return _answer(await self._changes.switch(who, request.path_params["container"], what, on=body.on))

    async def migrate(self, request: Request) -> Response:
        return _answer(await self._changes.migrate(self._who(request), await _body(request, changes.MigrateBody)))

    async def instantiate(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, changes.InstantiateBody)
        return _answer(await self._changes.instantiate(who, body))

    async def terminate(self, request: Request) -> Response:
        return _answer(await self._changes.terminate(self._who(request), await _body(request, changes.ProviderBody)))

    async def cancel_notification(self, request: Request) -> Response:
        return _answer(await self._changes.cancel_notification(self._who(request), request.path_params["id"]))

    async def detach_hook(self, request: Request) -> Response:
        return _answer(await self._changes.detach_hook(self._who(request), request.path_params["id"]))

    async def policy_file(self, request: Request) -> Response:
        return _answer(await self._files.policy_file(self._who(request)))

    async def try_policy(self, request: Request) -> Response:
        return _answer(await self._files.try_policy(self._who(request), await _body(request, changes.TextBody)))

    async def save_policy(self, request: Request) -> Response:
        return _answer(await self._files.save_policy(self._who(request), await _body(request, changes.FileBody)))

    async def rule_files(self, request: Request) -> Response:
        return _answer(await self._files.rule_files(self._who(request)))

    async def try_rules(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, changes.TextBody)
        return _answer(await self._files.try_rules(who, request.path_params["container"], body))

    async def save_rules(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, changes.FileBody)
        return _answer(await self._files.save_rules(who, request.path_params["container"], body))

    # --- calls

    async def call(self, request: Request) -> Response:
        who, body = self._authenticator.who(request.scope), await _body(request, messages.CallBody)
        handle = self._api.find(who, request.path_params["group"], request.path_params["name"], body.container)
        named = self._renewed(request, who, stops=handle.effect == "stop")
        async with self._client(request, who, named) as (client, alone):
            gone = lambda: _gone(request)  # noqa: E731
            run = await self._api.call(client, handle, body, gone, alone=alone)
        error = run.exception(0)
        if error is not None:
            return problem_response(error)
        try:
            return _answer({"result": run.result(0)})
        except messages.NO_JSON as bad:
            raise InvalidResult(service=handle.label, problem=f"it cannot be expressed in JSON: {bad}") from None

    # --- sessions

    async def open_session(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.SessionBody)
        client = await self._api.in_thread(self._api.clients.open, who)
        self._leases.begin(client, body.lease_s, lambda: self._authenticator.still(request.scope, who))
        return _answer(messages.SessionOpened(client.secret, client.session.name, body.lease_s), 201)

    async def session(self, request: Request) -> Response:
        client = self._lasting(request, self._who(request), "this")
        return _answer({"name": client.session.name, "lease_s": self._leases.lease_s(client)})

    async def close_session(self, request: Request) -> Response:
        client = self._lasting(request, self._who(request), "this")
        await self._api.in_thread(client.close, stops=True)
        return Response(status_code=204)

    # --- locks and stops

    async def locks(self, request: Request) -> Response:
        return _answer(await self._api.locks(self._who(request)))

    async def lock(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.LockBody)
        client = self._lasting(request, who, "a lock")
        return _answer(await self._api.lock(client, body, _lost), 201)

    async def unlock(self, request: Request) -> Response:
        client = self._lasting(request, self._who(request), "a lock")
        if not await self._api.in_thread(client.unlock, request.path_params["lock"]):
            raise HttpError(status=404, problem="this session has no such lock, or has lost it")
        return Response(status_code=204)

    async def request_release(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.RequestBody)
        return _answer({"asked": await self._api.request_release(who, body)})

    async def break_locks(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.RequestBody)
        return _answer(await self._api.break_locks(who, body))

    async def resume(self, request: Request) -> Response:
        who, body = self._who(request), await _body(request, messages.GroupBody)
        async with self._client(request, who, self._renewed(request, who)) as (client, _):
            return _answer({"resumed": await self._api.resume(client, body)})

    async def estops(self, request: Request) -> Response:
        return _answer(self._api.estops(self._who(request)))

    async def estop(self, request: Request) -> Response:
        who = self._authenticator.who(request.scope)
        self._renewed(request, who, stops=True)
        return _answer(await self._api.estop(who, await _body(request, messages.EstopBody)))

    async def clear(self, request: Request) -> Response:
        return _answer(await self._api.clear(self._who(request), await _body(request, messages.ClearBody)))

    # --- identities and sessions

    def _who(self, request: Request) -> str:
        who = self._authenticator.who(request.scope)
        self._renewed(request, who)
        return who

    def _renewed(self, request: Request, identity: str, *, stops: bool = False) -> Client | None:
        """Renews and returns the session that a request names; None if it names none.

        Raises NoSuchSession, except for a request that stops something: that needs no session (S07).
        """
        secret = request.headers.get(SESSION)
        if secret is None:
            return None
        try:
            client = self._api.clients.of(secret, identity)
        except NoSuchSession:
            if stops:
                return None
            raise
        self._leases.renew(client)
        return client

    def _lasting(self, request: Request, identity: str, what: str) -> Client:
        """The session that a request names. Raises NeedsSession, NoSuchSession."""
        client = self._renewed(request, identity)
        if client is None:
            raise NeedsSession(what=what)
        return client

    @asynccontextmanager
    async def _client(
        self, request: Request, identity: str, named: Client | None
    ) -> AsyncGenerator[tuple[Client, bool]]:
        """The session that a request names, or a temporary one; and whether it is temporary."""
        if named is not None:
            yield named, False
            return
        client = await self._api.in_thread(self._api.clients.open_for_one, identity, stops=True)
        self._leases.begin(client, 0, lambda: self._authenticator.still(request.scope, identity))
        try:
            yield client, True
        finally:
            await asyncio.shield(asyncio.ensure_future(self._api.in_thread(client.close, stops=True)))


def _lost(_name: str, _error: LockLost) -> None:
    """Ignores a lost lock, as a request cannot be notified; the next operation under the lock reports the loss."""


async def _gone(request: Request) -> None:
    """Waits until the client closes its end of the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def refusal(error: TradeError) -> Response:
    """Returns the error of a request that was not executed."""
    headers = {"WWW-Authenticate": 'Bearer realm="trade"'} if isinstance(error, NotAuthenticated) else None
    return problem_response(error, headers)


async def _body(request: Request, body_type: type[Body]) -> Body:
    """Decodes the client's body as the given record; an empty body is an empty record."""
    return messages.read(await received(request) or b"{}", msgspec.json.Decoder(body_type))


async def received(request: Request) -> bytes:
    """Returns the client's body. Raises HttpError, TooLarge: it is no JSON, too slow or too large."""
    media_type = request.headers.get("content-type", "application/json").partition(";")[0].strip().lower()
    if media_type != "application/json":
        raise HttpError(status=415, problem=f"send application/json, not {media_type}")
    try:
        return await asyncio.wait_for(_read(request), _BODY_S)
    except asyncio.TimeoutError:
        raise HttpError(status=408, problem=f"the body did not arrive within {_BODY_S:g} s") from None


async def _read(request: Request) -> bytes:
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        if len(data) > MOST_BODY_BYTES:
            path, size = request.url.path, len(data)
            raise TooLarge(service=path, what="a body", size_bytes=size, limit_bytes=MOST_BODY_BYTES)
    return bytes(data)


def _answer(value: Any, status: int = 200) -> Response:
    return Response(messages.encoder.encode(value), status, media_type="application/json")


async def refused(_request: Request, error: Exception) -> Response:
    """Returns errors of HTTP itself as a problem."""
    assert isinstance(error, HTTPException)  # noqa: S101 - the handler is registered for these
    problem = HttpError(status=error.status_code, problem=error.detail)
    return problem_response(problem, dict(error.headers or {}))


async def broken(_request: Request, _error: Exception) -> Response:
    """Handles an internal error, which the server logs."""
    return problem_response(HttpError(status=500, problem="internal error of the HTTP gateway. See its log"))
