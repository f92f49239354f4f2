"""An HTTP client that sets the pan joint moving and stays: ``page.py URL TOKEN socket|request|session|agent``."""

import json
import sys
import threading
import time
import urllib.request
from typing import Any

import anyio
import httpx
from mcp import ClientSession
from mcp.client.streamable_http import streamable_http_client
from websockets.sync.client import connect

CALL = {"args": [1.3, 0.1], "deadline_s": 120}
"""Far and slowly, as ``mover.py`` does."""
MOVE = "/call/rosie.neck.pan/move_to"


def main(url: str, token: str, how: str) -> None:
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}

    def ask(path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        with urllib.request.urlopen(urllib.request.Request(url + path, data, headers), timeout=120) as answer:
            return json.load(answer)

    match how:
        case "socket":
            with connect(url.replace("http", "ws", 1) + "/ws", additional_headers=headers) as socket:
                asked = {"do": "call", "id": 1, "group": "rosie.neck.pan", "name": "move_to", **CALL}
                socket.send(json.dumps(asked))
                say()
                socket.recv()
        case "request":
            say()
            ask(MOVE, CALL)
        case "session":
            headers["Trade-Session"] = ask("/session", {"lease_s": 1})["session"]
            moving = threading.Thread(target=ask, args=(MOVE, CALL))
            moving.start()
            say()
            while moving.is_alive():
                ask("/session")
                time.sleep(0.1)
        case "agent":
            anyio.run(act, url, token)


async def act(url: str, token: str) -> None:
    """Move as an agent does."""
    connections = httpx.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=120)
    async with (
        streamable_http_client(f"{url}/mcp", http_client=connections) as (hears, says, _),
        ClientSession(hears, says) as session,
    ):
        await session.initialize()
        await session.call_tool("lock", {"group": "rosie.neck.pan"})
        say()
        await session.call_tool("call", {"group": "rosie.neck.pan", "name": "move_to", **CALL})


def say() -> None:
    print("{}", flush=True)


main(*sys.argv[1:])
