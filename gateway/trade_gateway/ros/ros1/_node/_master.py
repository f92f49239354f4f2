"""The ROS master and the slave APIs of nodes: XML-RPC with a deadline for every call."""

from __future__ import annotations

import http.client
import xmlrpc.client
from typing import Any

_UNREACHABLE = (OSError, http.client.HTTPException, xmlrpc.client.ProtocolError)


class Unreachable(Exception):
    """No answer, or not in time."""


class Refused(Exception):
    """An answer that is not a success."""


class _Transport(xmlrpc.client.Transport):
    def __init__(self, timeout_s: float) -> None:
        super().__init__()
        self._timeout_s = timeout_s

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = self._timeout_s
        return connection


def ask(uri: str, method: str, *arguments: Any, timeout_s: float = 2.0) -> Any:
    """Calls a method of a ROS API and unwraps its (code, text, value).

    Raises:
        Unreachable: no answer within timeout_s.
        Refused: the callee reported a failure, with its text.
    """
    transport = _Transport(max(timeout_s, 0.05))
    try:
        proxy = xmlrpc.client.ServerProxy(uri, transport=transport)
        code, text, value = getattr(proxy, method)(*arguments)
    except _UNREACHABLE as error:
        raise Unreachable(str(error) or type(error).__name__) from None
    except (xmlrpc.client.Error, OverflowError, TypeError, ValueError) as error:
        raise Refused(str(error)) from None
    finally:
        transport.close()
    if code != 1:
        raise Refused(text)
    return value


def is_reachable(uri: str, name: str) -> bool:
    """Whether a node answers at its slave API."""
    try:
        ask(uri, "getPid", name, timeout_s=1.0)
    except Unreachable:
        return False
    except Refused:
        return True
    return True
