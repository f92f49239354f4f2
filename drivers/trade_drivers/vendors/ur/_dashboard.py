"""A client of a controller's dashboard server, and a check of its other services; on plain sockets, with deadlines."""

import socket
import struct
import threading
import time
from contextlib import suppress
from typing import Final

_PORT: Final = 29999
_RTDE: Final = 30004
_SCRIPT: Final = 30003
SERVICES: Final = {
    "dashboard server": f"dashboard server (port {_PORT})",
    "RTDE": f"RTDE (port {_RTDE})",
    "script port": f"script port (port {_SCRIPT})",
}
"""What the driver needs of a controller."""
_POLYSCOPE_X: Final = "A controller with PolyScope X has no dashboard server, and this driver cannot use it"
_SERVICES_ON: Final = "On its screen, enable it: Settings, Security, Services"
_GREETING: Final = "Universal Robots Dashboard Server"
_HELLO: Final = bytes.fromhex("0005560002")
"""RTDE: protocol version 2, please."""
_WELCOME: Final = bytes.fromhex("00045601")
_LONGEST: Final = 4096
_HEAD: Final = struct.Struct(">HB")
_INPUTS: Final = ord("I")
_REGISTER: Final = b"input_int_register_0"
"""The register with the commands for the control script of ur-rtde."""


class DashboardError(Exception):
    """The controller is absent, does not answer in time, or is another device."""


def ask(host: str, line: str, timeout_s: float) -> str:
    """Sends a line to the dashboard, and returns its answer.

    Raises:
        DashboardError: no answer in time.
    """
    until = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, _PORT), timeout_s) as connection:
            if _GREETING not in (greeting := _line(connection, until)):
                raise DashboardError(f"{host}:{_PORT} greets with {greeting!r}; is it a controller?")
            connection.sendall(line.encode() + b"\n")
            return _line(connection, until)
    except OSError as problem:
        raise DashboardError(f"{host}:{_PORT}: {problem or 'no answer'}") from None


def tell(host: str, line: str, timeout_s: float) -> threading.Thread:
    """Sends a line to the dashboard on a thread with a timeout; ignores the answer."""

    def say() -> None:
        with suppress(DashboardError):
            ask(host, line, timeout_s)

    saying = threading.Thread(target=say, name=f"dashboard of {host}", daemon=True)
    saying.start()
    return saying


def probe(host: str, timeout_s: float) -> None:
    """Checks that all services of the controller answer, because the library waits without a timeout.

    Raises:
        DashboardError: a service does not answer; the error names it, and those that do.
    """
    if not (problems := lacking(host, timeout_s)):
        return
    present = [text for name, text in SERVICES.items() if name not in problems]
    if not present:
        raise DashboardError(f"{next(iter(problems.values()))}; is it switched on, and is this its address?")
    absent = ", ".join(SERVICES[name] for name in problems)
    fixes = dict.fromkeys(remedy(name) for name in problems)
    why = "; ".join(problems.values())
    raise DashboardError(f"{host} has no {absent}, but it has {' and '.join(present)}. {'. '.join(fixes)}. ({why})")


def remedy(name: str) -> str:
    """Returns what to do about a service that does not answer."""
    return f"{_SERVICES_ON}. {_POLYSCOPE_X}" if name == "dashboard server" else _SERVICES_ON


def lacking(host: str, timeout_s: float) -> dict[str, str]:
    """Returns the services that do not answer, and why. Each has this time. Changes nothing."""
    problems: dict[str, str] = {}
    for name, check in (("dashboard server", _greets), ("RTDE", _speaks_rtde), ("script port", _takes_scripts)):
        try:
            check(host, timeout_s)
        except DashboardError as problem:
            problems[name] = str(problem)
    return problems


def _greets(host: str, timeout_s: float) -> None:
    ask(host, "robotmode", timeout_s)


def _speaks_rtde(host: str, timeout_s: float) -> None:
    until = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, _RTDE), timeout_s) as connection:
            connection.sendall(_HELLO)
            answer = _bytes(connection, len(_WELCOME), until)
    except OSError as problem:
        raise DashboardError(f"{host}:{_RTDE}: {problem or 'no answer'}") from None
    if answer != _WELCOME:
        raise DashboardError(f"{host}:{_RTDE} answers {answer.hex()}; RTDE of version 2 is needed")


def _takes_scripts(host: str, timeout_s: float) -> None:
    try:
        socket.create_connection((host, _SCRIPT), timeout_s).close()
    except OSError as problem:
        raise DashboardError(f"{host}:{_SCRIPT}: {problem or 'no answer'}") from None


def is_commanded(host: str, timeout_s: float) -> bool:
    """Returns whether another program has control of the arm, as a controller gives each register to one client.

    Writes nothing. If no client has the register, this connection takes it until the request is over.

    Raises:
        DashboardError: no answer in time.
    """
    until = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, _RTDE), timeout_s) as connection:
            connection.sendall(_HELLO + _HEAD.pack(_HEAD.size + len(_REGISTER), _INPUTS) + _REGISTER)
            while True:
                size, kind = _HEAD.unpack(_bytes(connection, _HEAD.size, until))
                body = _bytes(connection, max(0, size - _HEAD.size), until)
                if kind == _INPUTS:
                    return b"IN_USE" in body
    except OSError as problem:
        raise DashboardError(f"{host}:{_RTDE}: {problem or 'no answer'}") from None


def _line(connection: socket.socket, until: float) -> str:
    data = b""
    while not data.endswith(b"\n"):
        data += _some(connection, _LONGEST - len(data), until)
    return data.decode(errors="replace").strip()


def _bytes(connection: socket.socket, count: int, until: float) -> bytes:
    data = b""
    while len(data) < count:
        data += _some(connection, count - len(data), until)
    return data


def _some(connection: socket.socket, most: int, until: float) -> bytes:
    connection.settimeout(max(0.001, until - time.monotonic()))
    data = connection.recv(most)
    if not data:
        raise ConnectionResetError("it hung up")
    return data
