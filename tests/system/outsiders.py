"""Clients of the siege that use no TRADE library: ``outsiders.py NAMESPACE NAME ADDRESS``; see `careless`.

The first line of input says the rest as JSON. ``by`` is ``page``: a dashboard, over the WebSocket at ``url`` with a
``token``, which moves by holding a button, too; or ``agent``: tools of MCP, from a ``trade mcp`` that is its child.
"""

import itertools
import json
import os
import queue
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from tests.support.lock_log import now
from tests.system.careless import CENTRE_COUNTS, Careless, Refused
from tests.system.siege_records import CAN_BUS

_LATER_S = 0.5
"""What a busy computer may take to pass an order on."""
_ANSWERS_S = 2.0
"""So long after its deadline an answer may come; then no client waits any more."""
_LOOKS_S = 5.0
_JOG_RAD_S, _JOG_VALID_S, _JOG_EVERY_S, _JOG_DEADLINE_S = 0.1, 0.2, 0.08, 1.0
_END_COUNTS = 913
"""Where joints end, on either side: 1.4 rad."""


class Outsider(Careless):
    later_s = _LATER_S
    feels_its_locks = False

    def ask(self, what: str, patience_s: float, **more: Any) -> Any:
        """Have something done; raises Refused."""
        raise NotImplementedError

    def joints_of(self, services: Sequence[dict[str, Any]]) -> list[str]:
        return sorted(one["group"] for one in services if one["resources"] == [one["group"]])

    def take(self, robots: Sequence[str], wait_s: float) -> Any:
        taken: list[str] = []
        for robot in robots:
            try:
                taken.append(self.ask("lock", wait_s + _LOOKS_S, group=robot, wait_s=wait_s)["lock"])
            except Refused:
                with suppress(Refused):
                    self.give_back(taken)
                raise
        return taken

    def give_back(self, taken: Any) -> None:
        for lock in taken:
            self.ask("unlock", _LOOKS_S, lock=lock)

    def call(self, joint: str, service: str, args: Sequence[Any], deadline_s: float, taken: Any) -> None:
        self.ask("call", deadline_s + _ANSWERS_S, group=joint, name=service, args=list(args), deadline_s=deadline_s)


class Page(Outsider):
    def __init__(self, name: str, reported: dict[str, Any]) -> None:
        super().__init__(name, reported)
        self._url, self._token = reported["url"], reported["token"]
        self._socket: ClientConnection | None = None
        self._leaving = ExitStack()
        self._ids = itertools.count()
        self.ways.append(self._hold)

    def joints(self, robot: str) -> list[str]:
        asked = urllib.request.Request(f"{self._url}/services?name=move_to&group={robot}", headers=self._headers())
        try:
            if self._socket is None:
                url = self._url.replace("http", "ws", 1) + "/ws"
                opening = connect(url, additional_headers=self._headers(), open_timeout=_LOOKS_S, close_timeout=1)
                self._socket = self._leaving.enter_context(opening)
            with urllib.request.urlopen(asked, timeout=_LOOKS_S) as answer:
                return self.joints_of(json.load(answer))
        except (OSError, WebSocketException, ValueError) as gone:
            self.ended.wait(0.2)
            raise Refused("NoConnection", str(gone)) from gone

    def take(self, robots: Sequence[str], wait_s: float) -> Any:
        taken = super().take(robots, wait_s)
        return self._socket, taken

    def give_back(self, taken: Any) -> None:
        socket, locks = taken if isinstance(taken, tuple) else (self._socket, taken)
        if socket is self._socket:  # else they have gone with it
            super().give_back(locks)

    def call(self, joint: str, service: str, args: Sequence[Any], deadline_s: float, taken: Any) -> None:
        if taken is not None and taken[0] is not self._socket:
            raise Refused("NoConnection", "the lock went with it")
        super().call(joint, service, args, deadline_s, taken)

    def resume(self, joint: str) -> None:
        self.ask("resume", _LOOKS_S, group=joint)

    def _hold(self, hold: str, joint: str, taken: Any) -> None:
        """Hold to move: set-points that end by themselves, one after the other; at the end a stop, or nothing more.

        A drive gets speeds as such, and its log has no goal that would say whose motion it was.
        """
        if f".{CAN_BUS}." in joint:
            self._go(hold, joint, taken)
            return
        side, until = self.random.choice((-1, 1)), now() + 3 * self.random.random()
        while now() < until:
            self.order(
                hold,
                joint,
                CENTRE_COUNTS + side * _END_COUNTS,
                "set_velocity",
                (side * _JOG_RAD_S, _JOG_VALID_S),
                _JOG_DEADLINE_S,
                taken,
                _JOG_VALID_S,
            )
            threading.Event().wait(_JOG_EVERY_S)
        if taken is not None and self.random.random() < 0.5:
            self.call(joint, "stop", (), _JOG_DEADLINE_S, taken)

    def ask(self, what: str, patience_s: float, **more: Any) -> Any:
        number, until = next(self._ids), now() + patience_s
        if self._socket is None:
            raise Refused("NoConnection")
        try:
            self._socket.send(json.dumps({"do": what, "id": number, **more}))
            while True:
                reported = json.loads(self._socket.recv(timeout=max(0.0, until - now())))
                if reported.get("id") == number and "problem" in reported:
                    raise Refused(reported["problem"]["title"], reported["problem"].get("detail", ""))
                if reported.get("id") == number and "result" in reported:
                    return reported["result"]
        except (OSError, WebSocketException) as gone:  # a TimeoutError, too
            self._leave()
            raise Refused("NoConnection", str(gone)) from gone

    def _leave(self) -> None:
        self._socket = None
        with suppress(OSError, WebSocketException):
            self._leaving.close()

    def _headers(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self._token}"}

    def serve(self) -> None:
        super().serve()
        self._leave()


class Agent(Outsider):
    def __init__(self, name: str, reported: dict[str, Any]) -> None:
        super().__init__(name, reported)
        self._server = subprocess.Popen(
            [sys.executable, "-m", "trade_gateway", "mcp", "--name", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "TRADE_SYSTEM": f"{os.environ['TRADE_SYSTEM']}-0", "TRADE_CONNECT": reported["connect"]},
        )
        self._ids = itertools.count(1)
        self._said: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()
        self._request("initialize", 60.0, protocolVersion="2025-06-18", capabilities={}, clientInfo=_CLIENT)
        self._say(method="notifications/initialized")

    def joints(self, robot: str) -> list[str]:
        return self.joints_of(self.ask("services", _LOOKS_S, group=robot, name="move_to"))

    def resume(self, joint: str) -> None:
        """That is for people."""

    def ask(self, what: str, patience_s: float, **more: Any) -> Any:
        answer = self._request("tools/call", patience_s, name=what, arguments=more)
        text = "".join(part.get("text", "") for part in answer["content"])
        if answer.get("isError"):
            error, _, why = text.partition(":")
            raise Refused(error, why.strip())
        return json.loads(text)

    def _request(self, method: str, wait_s: float, **params: Any) -> dict[str, Any]:
        number, until = next(self._ids), now() + wait_s
        self._say(id=number, method=method, params=params)
        while True:
            try:
                reported = self._said.get(timeout=max(0.0, until - now()))
            except queue.Empty:
                raise Refused("NoAnswer", f"to {method}") from None
            if reported is None:
                raise Refused("NoServer", "it has ended")
            if reported.get("id") == number:
                return reported["result"]

    def _say(self, **message: Any) -> None:
        assert self._server.stdin is not None
        with suppress(OSError):  # it has ended: so it will not answer
            self._server.stdin.write(json.dumps({"jsonrpc": "2.0", **message}) + "\n")
            self._server.stdin.flush()

    def _listen(self) -> None:
        assert self._server.stdout is not None
        for line in self._server.stdout:
            self._said.put(json.loads(line))
        self._said.put(None)

    def serve(self) -> None:
        super().serve()
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait(20)


_CLIENT = {"name": "siege", "version": "0"}


def main(name: str) -> None:
    reported = json.loads(sys.stdin.readline())
    kind = {"page": Page, "agent": Agent}[reported["by"]]
    kind(name, reported).serve()


if __name__ == "__main__":
    main(sys.argv[2])
