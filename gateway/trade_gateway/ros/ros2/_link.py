# pyright: reportUnknownMemberType=false
"""The zenoh session at the router of ROS 2 (``rmw_zenohd``), separate from the sessions of TRADE.

It is a client; the nodes of ROS 2 are peers. Their router does not forward messages between peers
(``peers_failover_brokering`` is off in its configuration), but it serves clients.

After a lost connection, zenoh repeats all declarations. A client session cannot be opened without a router, so this
module retries until there is one, and then makes the declarations that were requested meanwhile.
"""

import contextlib
import json
import secrets
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import zenoh

from trade.errors import ConfigurationError

CLOSED: Final = (zenoh.ZError, RuntimeError)
"""What zenoh raises for an object that is already closed, or that another thread is closing or using."""
_OPEN_MS: Final = 500
_AGAIN_S: Final = 0.5
_LEASE_MS: Final = 2000
_END_S: Final = 5.0


class ZenohDeclaration(Protocol):
    """A declaration of zenoh."""

    def undeclare(self) -> Any: ...


Declare = Callable[[zenoh.Session], Sequence[ZenohDeclaration]]


class Declaration:
    """A declaration that is made, or will be made once there is a router."""

    def __init__(self, link: "Link", declare: Declare) -> None:
        self._link = link
        self.declare: Final = declare
        self.made: Sequence[ZenohDeclaration] = ()

    def close(self) -> None:
        """Withdraws the declaration. Idempotent."""
        for made in self._link.forget(self):
            with contextlib.suppress(*CLOSED):
                made.undeclare()


class Link:
    """Opens the session and keeps the declarations. See the module."""

    def __init__(self, router: str) -> None:
        """Raises ConfigurationError: this is not an endpoint of zenoh."""
        self.id: Final = f"{secrets.randbelow(15) + 1:x}{secrets.token_hex(15)}{secrets.randbelow(16):x}"
        self._router = router
        self._config = _configuration(router, self.id)
        self._lock = threading.Lock()
        self._declared: list[Declaration] = []
        self._session: zenoh.Session | None = None
        self._closed = threading.Event()
        self._opening = threading.Thread(target=self._open, name=f"ros2 {router}", daemon=True)
        if not self._try_to_open():
            self._opening.start()

    @property
    def problem(self) -> str:
        """Empty if the router is connected, else why not."""
        session = self._session
        with contextlib.suppress(*CLOSED):
            if session is not None and list(session.info.routers_zid()):
                return ""
        return f"no zenoh router at {self._router}; is rmw_zenohd running?"

    @property
    def session(self) -> zenoh.Session | None:
        """The session; None before the first contact with a router, and after the end."""
        return self._session

    def declare(self, declare: Declare) -> Declaration:
        """Makes a declaration, now or once there is a session.

        Args:
            declare: receives the session, returns what to undeclare, in this order. It is called with a lock held.
        """
        declared = Declaration(self, declare)
        with self._lock:
            self._declared.append(declared)
            if self._session is not None:
                declared.made = declare(self._session)
        return declared

    def forget(self, declared: Declaration) -> Sequence[ZenohDeclaration]:
        """Returns the declarations to undeclare; nothing the second time."""
        with self._lock:
            if declared in self._declared:
                self._declared.remove(declared)
            made, declared.made = declared.made, ()
        return made

    def close(self) -> None:
        """Ends the session and with it all declarations. Idempotent."""
        self._closed.set()
        if self._opening.is_alive():
            self._opening.join(_END_S)
        with self._lock:
            session, self._session = self._session, None
            self._declared.clear()
        if session is not None:
            with contextlib.suppress(*CLOSED):
                session.close()

    def _open(self) -> None:
        while not self._closed.wait(_AGAIN_S):
            if self._try_to_open():
                return

    def _try_to_open(self) -> bool:
        try:
            session = zenoh.open(self._config)
        except zenoh.ZError:
            return False
        with self._lock:
            if not self._closed.is_set():
                self._session = session
                for declared in self._declared:
                    declared.made = declared.declare(session)
                return True
        session.close()
        return True


def _configuration(router: str, session_id: str) -> zenoh.Config:
    settings: dict[str, Any] = {
        "id": session_id,
        "mode": "client",
        "connect/timeout_ms": _OPEN_MS,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # latched messages can only be found by their timestamps
        "timestamping/enabled": True,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/tx/keep_alive": 4,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        config.insert_json5("connect/endpoints", json.dumps([router]))
    except zenoh.ZError as bad:
        problem = f"{bad}; write it like tcp/localhost:7447"
        raise ConfigurationError(where=f"router {router!r}", problem=problem) from None
    return config
