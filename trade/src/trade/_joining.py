"""How a container comes into its system: where it listens, whom it dials, with which credentials."""

import contextlib
import logging
from typing import Final

from trade._credentials import user_secret
from trade._endpoints import Endpoint, dialled_from_here, with_free_port
from trade._rendezvous import Rendezvous
from trade._settings import Settings
from trade._zenoh import ZenohTransport, configuration
from trade.errors import ConfigurationError

__all__ = ["join"]

_logger = logging.getLogger("trade")
_ANYWHERE_HERE: Final = Endpoint("tcp", "127.0.0.1", 0)
_PORTS_TRIED: Final = 4


def join(settings: Settings, leaving: contextlib.ExitStack) -> ZenohTransport:
    """Open the main session; what has to be undone when the container leaves goes onto the stack."""
    wanted = [Endpoint.read(endpoint) for endpoint in settings.listen] or [_ANYWHERE_HERE]
    for _ in range(0 if all(endpoint.port for endpoint in wanted) else _PORTS_TRIED):
        with contextlib.suppress(ConfigurationError):  # somebody else took the free port first
            return _join_at(settings, _chosen(wanted), leaving)
    return _join_at(settings, _chosen(wanted), leaving)


def _chosen(wanted: list[Endpoint]) -> list[str]:
    return [str(with_free_port(endpoint)) for endpoint in wanted]


def _join_at(settings: Settings, listen: list[str], leaving: contextlib.ExitStack) -> ZenohTransport:
    connect = list(settings.connect)
    if not connect:
        rendezvous = Rendezvous(settings.system)
        leaving.callback(rendezvous.leave)
        connect = rendezvous.enter(_nearest(listen))
    if settings.insecure_lan:
        _logger.warning("TRADE_INSECURE_LAN: %s is open to its network, unencrypted, without a policy", listen)
    credentials = settings.credentials or user_secret()
    return ZenohTransport(
        configuration(namespace=settings.system, listen=listen, connect=connect, credentials=credentials)
    )


def _nearest(listen: list[str]) -> str:
    """Where others of this host dial: the loopback interface if we listen there."""
    endpoints = sorted(map(Endpoint.read, listen), key=lambda endpoint: not endpoint.loopback)
    return dialled_from_here(endpoints[0])
