"""Serves the dashboard's files with their HTTP headers."""

import hashlib
from importlib.resources import files
from typing import Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

_MODULES: Final = (
    "app",
    "calls",
    "chain",
    "confirm",
    "containers",
    "devices",
    "editor",
    "gateway",
    "estop",
    "faults",
    "graph",
    "jog",
    "locks",
    "log",
    "page",
    "robots",
    "schemas",
    "services",
    "system",
)
_FILES: Final = (
    ("/", "index.html", "text/html"),
    *((f"/dashboard/{name}.js", f"{name}.js", "text/javascript") for name in _MODULES),
    ("/dashboard/style.css", "style.css", "text/css"),
    ("/dashboard/icon.svg", "icon.svg", "image/svg+xml"),
)
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
"""Content security policy: only the page's own scripts run, and no other site may embed the page."""


def pages() -> list[Route]:
    """One route for each file. They contain nothing about the system, so anyone who can connect may read them."""
    folder = files(__name__.rpartition(".")[0]) / "static"
    return [_route(path, (folder / name).read_bytes(), kind) for path, name, kind in _FILES]


def _route(path: str, body: bytes, content_type: str) -> Route:
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'

    async def answer(request: Request) -> Response:
        headers = {**HEADERS, "ETag": tag}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(body, headers=headers, media_type=content_type)

    return Route(path, answer, methods=["GET"])
