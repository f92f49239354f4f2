"""An HTTP gateway of a system in memory, and clients of it over real sockets."""

import http.client
import json
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from websockets.sync.client import ClientConnection, connect

from tests.support.policies import EVERYTHING, policy_text
from tests.support.two_joint_robot import Joint, Robot
from tests.support.waiting import PATIENCE_S
from trade import Container, service
from trade.testing import memory_system
from trade_gateway.http import HttpGateway, Tokens, add_token

POLICY = policy_text(
    "tester=all chief=all anna=operator bert=viewer",
    all=EVERYTHING,
    operator="call=robot.a read=robot.a lock=robot.a",
    viewer="read=robot",
)
"""Who may do what at an HTTP gateway that is `governed`."""


class Axis(Joint):
    """A joint whose move can be ended early."""

    @service(cancel="stop")
    def move_to(self, value: float) -> float:
        self.entered.set()
        self.stopped.wait(PATIENCE_S)
        return value


@dataclass
class Answer:
    status: int
    headers: dict[str, str]
    body: Any

    @property
    def title(self) -> str:
        """The name of the error."""
        return self.body["title"]


@dataclass
class Client:
    """A client outside; each request has a connection of its own."""

    url: str
    token: str = ""
    session: str = ""
    headers: dict[str, str] = field(default_factory=dict)
    trust: ssl.SSLContext | None = None

    def begin(self, method: str, path: str, body: Any = None, **headers: str) -> http.client.HTTPConnection:
        """Send a request, and do not wait for its answer."""
        place = urlsplit(self.url)
        if place.scheme == "https":
            made = http.client.HTTPSConnection(place.netloc, timeout=PATIENCE_S, context=self.trust)
        else:
            made = http.client.HTTPConnection(place.netloc, timeout=PATIENCE_S)
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        sent = {"Content-Type": "application/json"} if data is not None else {}
        if self.token:
            sent["Authorization"] = f"Bearer {self.token}"
        if self.session:
            sent["Trade-Session"] = self.session
        named = {name.replace("_", "-"): text for name, text in headers.items()}
        with suppress(BrokenPipeError, ConnectionResetError):  # refused before all of it was sent
            made.request(method, path, data, {**sent, **self.headers, **named})
        return made

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        made = self.begin(method, path, body, **headers)
        try:
            reported = made.getresponse()
            data = reported.read()
            found = {name.lower(): text for name, text in reported.getheaders()}
            return Answer(reported.status, found, json.loads(data) if "json" in found.get("content-type", "") else data)
        finally:
            made.close()

    def call(self, what: str, *args: Any, **options: Any) -> Answer:
        """``group.name``."""
        group, _, name = what.rpartition(".")
        return self.ask("POST", f"/call/{group}/{name}", {"args": list(args), **options})

    def opened(self, **options: Any) -> "Client":
        """The same client in a session that lasts."""
        answer = self.ask("POST", "/session", options)
        assert answer.status == 201, answer
        return Client(self.url, self.token, answer.body["session"])

    def socket(self, **options: Any) -> ClientConnection:
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        return connect(
            self.url.replace("http", "ws", 1) + "/ws", additional_headers=headers, open_timeout=PATIENCE_S, **options
        )


@dataclass
class Opened:
    """An HTTP gateway, its tokens, and the robot behind it."""

    robot: Robot
    gateway: HttpGateway
    tokens: Path

    def client(self, name: str = "anna") -> Client:
        return Client(self.gateway.url, add_token(self.tokens, name))

    def __getitem__(self, name: str) -> Joint:
        return self.robot.joints[name]


@contextmanager
def opened(container: Container, folder: Path, **options: Any) -> Iterator[tuple[HttpGateway, Path]]:
    """An HTTP gateway of a container, to which `stranger` has a token."""
    tokens = folder / "tokens.toml"
    add_token(tokens, "stranger")
    with HttpGateway(container, listen="127.0.0.1:0", tokens=Tokens(tokens), **options) as gateway:
        yield gateway, tokens


@contextmanager
def served_axis(folder: Path) -> Iterator[Opened]:
    """An HTTP gateway of a robot with one joint more, `axis`; all joints stop in the end."""
    with memory_system() as system:
        robot = Robot(system)
        axis = Axis("axis")
        robot.joints["axis"] = axis
        system.container("axis").register(axis, "robot.axis")
        system.settle()
        with opened(robot.me, folder) as (gateway, tokens):
            yield Opened(robot, gateway, tokens)
        for joint in robot.joints.values():
            joint.hold.set()
            joint.stopped.set()


def heard(socket: ClientConnection) -> Any:
    """The next message."""
    return json.loads(socket.recv(timeout=PATIENCE_S))


def say(socket: ClientConnection, **message: Any) -> None:
    socket.send(json.dumps(message))


def ask(socket: ClientConnection, **message: Any) -> Any:
    """Say something and wait for what it comes to; whatever else is said meanwhile is left out."""
    say(socket, **message)
    while True:
        reported = heard(socket)
        if reported.get("id") == message["id"] and ("result" in reported or "problem" in reported):
            return reported


def govern(robot: Robot, folder: Path, text: str) -> None:
    """Give the HTTP gateway's container a policy."""
    path = folder / "policy.toml"
    path.write_text(text)
    robot.me.load_policy(path)


@contextmanager
def governed(folder: Path) -> Iterator[Opened]:
    """An HTTP gateway that may do everything, in a system with a policy."""
    with memory_system() as system:
        robot = Robot(system)
        govern(robot, folder, POLICY)
        with opened(robot.me, folder) as (made, tokens):
            yield Opened(robot, made, tokens)
