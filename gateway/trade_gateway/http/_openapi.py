"""The HTTP API as an OpenAPI document: its own operations, and the services that the client may know of now."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, Final, cast

import msgspec

from trade import Handle, HookInfo, LoadInfo, NotificationInfo, Reachability
from trade_gateway.clients import _changes as changes
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._problems import Problem
from trade_gateway.http._origin_check import MEDIA_TYPE

Schema = dict[str, Any]

_OPENAPI: Final = "3.1.0"
_BODIES: Final = (
    messages.CallBody,
    messages.LockBody,
    messages.GroupBody,
    messages.RequestBody,
    messages.EstopBody,
    messages.ClearBody,
    messages.SessionBody,
    messages.SwitchBody,
    changes.ReasonBody,
    changes.MigrateBody,
    changes.ProviderBody,
    changes.InstantiateBody,
    changes.TextBody,
    changes.FileBody,
    changes.FileView,
    changes.Trial,
    changes.ContainerState,
    changes.Done,
    messages.Me,
    messages.ServiceView,
    messages.ContainerView,
    messages.LockView,
    messages.LockTaken,
    messages.SessionOpened,
    messages.EstopView,
    messages.Stopped,
    LoadInfo,
    NotificationInfo,
    HookInfo,
    Reachability,
    Problem,
)
_COMPONENTS: Final = "#/components/schemas/"
_FORMATS: Final = {"datetime": "date-time", "date": "date", "time": "time", "UUID": "uuid"}
_TAG: Final = "gateway"
_VALUES: Final = ("const", "default", "enum", "examples")
"""Keys whose values are data, not schemas."""
_SESSION: Final = {
    "name": "Trade-Session",
    "in": "header",
    "description": "A session that POST /session opened; without it the request has a session of its own.",
    "schema": {"type": "string"},
}


def document(handles: Sequence[Handle]) -> Schema:
    """Returns the document, as JSON.

    Args:
        handles: the services to describe, each under ``/call/GROUP/NAME``.
    """
    _, components = msgspec.json.schema_components(_BODIES, ref_template=_COMPONENTS + "{name}")
    schemas: Schema = _led(components, "")
    schemas["Problem"]["additionalProperties"] = True
    call = schemas.pop("CallBody")
    paths: Schema = {}
    for handle in handles:
        path = f"/call/{handle.key.domain}/{handle.name}"
        if path not in paths:
            paths[path] = {"post": _call(handle, call, schemas)}
    return {
        "openapi": _OPENAPI,
        "info": {"title": "TRADE", "version": version("trade-gateway"), "description": __doc__},
        "paths": {**paths, **_fixed()},
        "components": {
            "schemas": schemas,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"token": []}],
    }


def _call(handle: Handle, call: Schema, schemas: Schema) -> Schema:
    record, described = handle.record, handle.schema
    name = f"{handle.key.domain}.{handle.name}"
    arguments = _placed(described["arguments"], name, schemas)
    named = {**arguments, "additionalProperties": False}
    needs_some = any(one.required for one in record.info.parameters)
    body = {**call, "properties": {**call["properties"], "args": named}, "required": ["args"] if needs_some else []}
    result = {
        "type": "object",
        "properties": {"result": _placed(described["result"], name, schemas)},
        "required": ["result"],
    }
    return {
        "operationId": name,
        "summary": handle.signature,
        "description": handle.doc,
        "tags": [handle.key.domain],
        "parameters": [_SESSION],
        "requestBody": _json(body, required=needs_some),
        "responses": _responses(result),
        "x-trade-effect": handle.effect,
        "x-trade-needs": handle.needs,
        "x-trade-achieves": handle.achieves,
    }


def _placed(schema: Mapping[str, Any], name: str, schemas: Schema) -> Schema:
    """Returns a service's schema; moves its definitions into the document, prefixed with the service's name."""
    own = schema.get("$defs", {})
    for title, definition in own.items():
        schemas[f"{name}.{title}"] = _led(definition, name)
    return _led({key: value for key, value in schema.items() if key != "$defs"}, name)


def _led(part: Any, name: str) -> Any:
    """Points references into the document, and adds formats and ranges of integers.

    Titles are removed, as client generators use them as names, which must be unique. ``items: false`` is removed
    because few generators support it: the greatest length says the same.
    """
    if isinstance(part, list):
        return [_led(one, name) for one in cast("list[Any]", part)]
    if not isinstance(part, dict):
        return part
    led = {
        key: value if key in _VALUES else _led(value, name)
        for key, value in cast("Schema", part).items()
        if not (key == "title" and isinstance(value, str))
    }
    if name and isinstance(ref := led.get("$ref"), str):
        led["$ref"] = f"{_COMPONENTS}{name}.{ref.rpartition('/')[2]}"
    if led.get("items") is False:
        del led["items"]
        led.setdefault("maxItems", len(led.get("prefixItems", ())))
    if (form := _FORMATS.get(str(led.get("x-trade-kind")))) is not None:
        led.setdefault("format", form)
    if led.get("type") == "integer":
        led = {"minimum": messages.LEAST_INTEGER, "maximum": messages.MOST_INTEGER, **led}
    return led


# --- operations of the API itself


def _fixed() -> Schema:
    query = [
        {"name": name, "in": "query", "schema": {"type": "string"}, "description": text}
        for name, text in (
            ("group", "This group and beneath it."),
            ("name", "`*` and `?` are wildcards."),
            ("needs", "A predicate that one of its pre-conditions fits: `see(?x)`."),
            ("achieves", "A predicate that one of its post-conditions fits."),
        )
    ]
    held = {**_SESSION, "required": True}
    names = {"type": "array", "items": {"type": "string"}}
    asked = {"type": "object", "properties": {"asked": names}, "required": ["asked"]}
    resumed = {"type": "object", "properties": {"resumed": names}, "required": ["resumed"]}
    opened = {"type": "object", "properties": {"name": {"type": "string"}, "lease_s": {"type": "number"}}}
    return {
        "/openapi.json": {"get": _operation("document", "This document.", {"type": "object"})},
        "/services": {"get": _operation("services", "Services.", _list("ServiceView"), parameters=query)},
        "/me": {"get": _operation("me", "The client's identity, and its rights over the system.", _ref("Me"))},
        "/containers": {"get": _operation("containers", "Containers.", _list("ContainerView"))},
        "/sight": {"get": _operation("sight", "Containers found, and endpoints without any.", _ref("Reachability"))},
        "/loads": {
            "get": _operation("loads", "Load of the containers, measured during one second.", _list("LoadInfo"))
        },
        "/notifications": {"get": _operation("notifications", "Active notifications.", _list("NotificationInfo"))},
        "/hooks": {"get": _operation("hooks", "Attached hooks.", _list("HookInfo"))},
        **_changes(),
        "/session": {
            "post": _operation(
                "open_session", "Open a session.", _ref("SessionOpened"), body="SessionBody", status="201"
            ),
            "get": _operation(
                "renew_session", "Renew a session, as any request in it does.", opened, parameters=[held]
            ),
            "delete": _operation(
                "end_session", "End a session and stop its motion.", None, parameters=[held], status="204"
            ),
        },
        "/locks": {
            "get": _operation("locks", "Locks.", _list("LockView")),
            "post": _operation(
                "take_lock",
                "Take a lock.",
                _ref("LockTaken"),
                body="LockBody",
                needed=True,
                parameters=[held],
                status="201",
            ),
        },
        "/locks/request": {
            "post": _operation(
                "request_locks", "Ask the owners of locks to release them.", asked, body="RequestBody", needed=True
            )
        },
        "/locks/break": {
            "post": _operation("break_locks", "Break locks.", _list("LockView"), body="RequestBody", needed=True)
        },
        "/locks/{lock}": {
            "delete": _operation(
                "release_lock", "Release a lock.", None, parameters=[*_in_path("/locks/{lock}"), held], status="204"
            )
        },
        "/resume": {
            "post": _operation(
                "resume",
                "Let move again what another client stopped.",
                resumed,
                body="GroupBody",
                needed=True,
                parameters=[_SESSION],
            )
        },
        "/estops": {"get": _operation("estops", "Open e-stops.", _list("EstopView"))},
        "/estop": {
            "post": _operation("estop", "Stop everything. Not safety-rated.", _ref("Stopped"), body="EstopBody")
        },
        "/estop/clear": {"post": _operation("clear_estops", "Clear e-stops.", _ref("Stopped"), body="ClearBody")},
    }


def _changes() -> Schema:
    """The operations that change the system."""
    posts = {
        "/containers/{container}/restart": (
            "restart",
            "Start a supervised container, or start it again.",
            "ReasonBody",
        ),
        "/containers/{container}/end": ("end", "End a container.", "ReasonBody"),
        "/containers/{container}/discovery": ("discovery", "Switch discovery of a container.", "SwitchBody"),
        "/containers/{container}/broadcast": ("broadcast", "Switch broadcasting of a container.", "SwitchBody"),
        "/migrate": ("migrate", "Move a provider with its state.", "MigrateBody"),
        "/instantiate": ("instantiate", "Create a provider.", "InstantiateBody"),
        "/terminate": ("terminate", "End a created provider.", "ProviderBody"),
    }
    deletes = {
        "/notifications/{id}": ("cancel_notification", "End a notification."),
        "/hooks/{id}": ("detach_hook", "Detach a hook."),
    }
    found: Schema = {"/system": {"get": _operation("system", "Containers, and their state.", _list("ContainerState"))}}
    for path, (name, summary, body) in posts.items():
        needed = body != "ReasonBody"
        operation = _operation(name, summary, _ref("Done"), body=body, needed=needed, parameters=_in_path(path))
        found[path] = {"post": operation}
    for path, (name, summary) in deletes.items():
        found[path] = {"delete": _operation(name, summary, _ref("Done"), parameters=_in_path(path))}
    return {**found, **_files()}


def _files() -> Schema:
    """The operations on the policy and the rules."""

    def put(path: str, name: str, summary: str) -> Schema:
        return _operation(name, summary, _ref("Done"), body="FileBody", needed=True, parameters=_in_path(path))

    def attempt(path: str, name: str, summary: str) -> Schema:
        return _operation(name, summary, _ref("Trial"), body="TextBody", needed=True, parameters=_in_path(path))

    return {
        "/policy/file": {
            "get": _operation("policy_file", "The policy file.", _ref("FileView")),
            "put": put("/policy/file", "save_policy", "Replace the policy file."),
        },
        "/policy/test": {"post": attempt("/policy/test", "try_policy", "What a changed policy would do.")},
        "/rules": {"get": _operation("rule_files", "Rules files.", _list("FileView"))},
        "/rules/{container}": {"put": put("/rules/{container}", "save_rules", "Replace a rules file.")},
        "/rules/{container}/test": {
            "post": attempt("/rules/{container}/test", "try_rules", "What changed rules would do now.")
        },
    }


def _in_path(path: str) -> list[Schema]:
    names = [word[1:-1] for word in path.split("/") if word.startswith("{")]
    return [{"name": name, "in": "path", "required": True, "schema": {"type": "string"}} for name in names]


def _operation(
    name: str,
    summary: str,
    answer: Schema | None,
    *,
    body: str = "",
    needed: bool = False,
    parameters: Sequence[Schema] = (),
    status: str = "200",
) -> Schema:
    asked = {"requestBody": _json(_ref(body), required=needed)} if body else {}
    operation = {"operationId": name, "summary": summary, "tags": [_TAG]}
    return {**operation, "parameters": list(parameters), **asked, "responses": _responses(answer, status)}


def _responses(answer: Schema | None, status: str = "200") -> Schema:
    done = {"description": "Done.", **({} if answer is None else _content(answer, "application/json"))}
    return {status: done, "default": {"description": "The error.", **_content(_ref("Problem"), MEDIA_TYPE)}}


def _json(schema: Schema, *, required: bool) -> Schema:
    return {"required": required, **_content(schema, "application/json")}


def _content(schema: Schema, media_type: str) -> Schema:
    return {"content": {media_type: {"schema": schema}}}


def _ref(name: str) -> Schema:
    return {"$ref": _COMPONENTS + name}


def _list(name: str) -> Schema:
    return {"type": "array", "items": _ref(name)}
