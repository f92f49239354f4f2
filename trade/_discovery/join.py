"""How a container joins its system: its endpoints, the peers that it dials or the hub, its credentials, its bridges."""

import contextlib
import logging
import socket
from collections.abc import Sequence
from typing import Any, Final

from trade._discovery.host_folder import HostFolder
from trade._security.certificates import Certificate
from trade._security.network_crossings import crossings
from trade._security.policy_file import read_policy
from trade._security.zenoh_acl import acl
from trade._settings import Settings
from trade.errors import ConfigurationError
from trade.hub_file import HubFile
from trade.transport.credentials import user_secret
from trade.transport.endpoints import Endpoint, dialled_from_here, loopback_interface, with_free_port
from trade.transport.port_guard import MOST_STRANGERS, MOST_WITH_TLS, PortGuard
from trade.transport.precedence import precedence
from trade.transport.zenoh import ZenohTransport, configuration
from trade.transport.zenoh_links import Links

_logger = logging.getLogger("trade")
_PORTS_TRIED: Final = 4


def join(settings: Settings, certificate: Certificate | None, leaving: contextlib.ExitStack) -> ZenohTransport:
    """Opens the transport, and adds to the stack what has to close with the container.

    Args:
        settings: of the container.
        certificate: of the container.
        leaving: the stack.
    """
    networks = _networks(settings)
    transport = _attached(settings, certificate) or _join(settings, certificate, networks, leaving)
    try:
        _check_bridged(settings.bridge, transport.links)
    except ConfigurationError:
        transport.close()
        raise
    most = MOST_STRANGERS if certificate is None else MOST_WITH_TLS
    links = transport.links
    guard = PortGuard((own.port for own in links.listen), links.count, links.far_ends, most)
    leaving.callback(guard.close)
    return transport


def _attached(settings: Settings, certificate: Certificate | None) -> ZenohTransport | None:
    """The transport through the hub of this host; None if there is none that this container can use."""
    if settings.hub != "auto" or settings.listen or settings.connect or settings.bridge:
        return None
    hub = HubFile(settings.system).running()
    if hub is None or not _of_our_kind([hub.endpoint], certificate is not None):
        return None
    why = _distrust(settings, hub.identity)
    if not why:
        try:
            return ZenohTransport(_configuration(settings, certificate, hub=hub.endpoint))
        except ConfigurationError:
            why = "it does not accept the link; does it have the same credentials, and does it answer?"
    _logger.warning("does not use the hub of this host at %s: %s Trying the other containers", hub.endpoint, why)
    return None


def _distrust(settings: Settings, identity: str) -> str:
    """Why a hub may not pass on what others say, by the policy; empty if it may."""
    policy = read_policy(settings.policy) if settings.policy and settings.tls else None
    if policy is None or (identity in policy.gateways and identity not in policy.revoked):
        return ""
    return f"the policy does not list its identity, {identity}, in gateways."


def _join(
    settings: Settings, certificate: Certificate | None, networks: list[list[str]], leaving: contextlib.ExitStack
) -> ZenohTransport:
    anywhere_here = Endpoint("tcp" if certificate is None else "tls", "127.0.0.1", 0)
    wanted = [Endpoint.read(endpoint) for endpoint in settings.listen] or [anywhere_here]
    if settings.hub == "serve":
        # Of many containers that compute at the same time, each would get as much of a processor as the hub of all.
        with precedence("the hub"):
            return _serve(settings, certificate, wanted, networks, leaving)
    return _join_anywhere(settings, certificate, wanted, networks, leaving)


def _serve(
    settings: Settings,
    certificate: Certificate | None,
    wanted: list[Endpoint],
    networks: list[list[str]],
    leaving: contextlib.ExitStack,
) -> ZenohTransport:
    """Joins as the hub of this host, at the port of the one before: attached containers look for it only there."""
    if why := _distrust(settings, settings.identity):
        raise ConfigurationError(where="hub", problem=f"{why} No container could attach; add it")
    file = HubFile(settings.system)
    file.claim()
    leaving.callback(file.release)
    before, transport = file.last(), None
    port = 0 if before is None else Endpoint.read(before.endpoint).port
    if port and not all(endpoint.port for endpoint in wanted):
        again = [endpoint if endpoint.port else endpoint._replace(port=port) for endpoint in wanted]
        try:
            transport = _join_at(settings, certificate, list(map(str, again)), networks, leaving)
        except ConfigurationError:
            _logger.warning("port %d of the last hub is taken: containers that were attached have to restart", port)
    transport = transport or _join_anywhere(settings, certificate, wanted, networks, leaving)
    try:
        file.announce(_nearest(list(map(str, transport.links.listen))), settings.identity)
    except ConfigurationError:
        transport.close()
        raise
    return transport


def _join_anywhere(
    settings: Settings,
    certificate: Certificate | None,
    wanted: list[Endpoint],
    networks: list[list[str]],
    leaving: contextlib.ExitStack,
) -> ZenohTransport:
    for _ in range(0 if all(endpoint.port for endpoint in wanted) else _PORTS_TRIED):
        with contextlib.suppress(ConfigurationError):  # another process took the free port first
            return _join_at(settings, certificate, _chosen(wanted), networks, leaving)
    return _join_at(settings, certificate, _chosen(wanted), networks, leaving)


def _chosen(wanted: list[Endpoint]) -> list[str]:
    return [str(with_free_port(endpoint)) for endpoint in wanted]


def _join_at(
    settings: Settings,
    certificate: Certificate | None,
    listen: list[str],
    networks: list[list[str]],
    leaving: contextlib.ExitStack,
) -> ZenohTransport:
    connect, certified = list(settings.connect), certificate is not None
    rendezvous: HostFolder | None = None
    if networks or not settings.connect:
        rendezvous = HostFolder(settings.system)
        leaving.callback(rendezvous.leave)
        connect += _of_our_kind(rendezvous.enter(_nearest(listen)), certified)
    if settings.insecure_lan and not certified:
        _logger.warning("TRADE_INSECURE_LAN: %s is open to its network, unencrypted", listen)
    began_ns = None if rendezvous is None else rendezvous.entered_ns
    transport = ZenohTransport(
        _configuration(settings, certificate, listen=listen, connect=connect, began_ns=began_ns, bridge=networks)
    )
    if rendezvous is not None:
        transport.keep_files = rendezvous.keep
    return transport


def _configuration(
    settings: Settings,
    certificate: Certificate | None,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    began_ns: int | None = None,
    bridge: Sequence[Sequence[str]] = (),
    hub: str = "",
) -> dict[str, Any]:
    return configuration(
        namespace=settings.system,
        listen=listen,
        connect=connect,
        began_ns=began_ns,
        credentials=None if certificate is not None else settings.credentials or user_secret(),
        certificate=certificate,
        bridge=bridge,
        hub=hub,
        rules=_rules(settings, bridge),
    )


def _rules(settings: Settings, networks: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The transport's access rules: the rights of certified identities, and what crosses a gateway."""
    policy = read_policy(settings.policy) if settings.policy and settings.tls else None
    if policy is None and settings.exports is None:
        return {}
    if policy is not None and (patterns := policy.patterns()):
        _logger.warning(
            "%s: %s: the transport needs full names; identities that only such a pattern matches can send nothing",
            policy.source,
            ", ".join(patterns),
        )
    crossing = None
    if settings.exports is not None:
        known = crossings(settings.exports, settings.stream_hz)
        crossing = {tuple(interfaces): known[interfaces[0]] for interfaces in networks}
    return acl(policy, namespace=settings.system, networks=crossing)


def _of_our_kind(endpoints: list[str], certified: bool) -> list[str]:
    """The endpoints that this container can link to: all of a system have certificates, or none has."""
    linkable = [endpoint for endpoint in endpoints if (Endpoint.read(endpoint).protocol == "tls") == certified]
    if others := [endpoint for endpoint in endpoints if endpoint not in linkable]:
        kinds = ("without certificates", "with certificates")
        _logger.warning(
            "%s: %s, and this container is %s: they cannot be linked. Set TRADE_TLS for the whole system or for none",
            ", ".join(others),
            kinds[not certified],
            kinds[certified],
        )
    return linkable


def _nearest(listen: list[str]) -> str:
    """The endpoint for others on this host: on the loopback interface if this container listens there."""
    endpoints = sorted(map(Endpoint.read, listen), key=lambda endpoint: not endpoint.loopback)
    return dialled_from_here(endpoints[0])


def _networks(settings: Settings) -> list[list[str]]:
    """The interfaces of each network that a bridge joins; the containers of its own host belong to the first.

    A hub that is no bridge has one network, of all interfaces.

    Raises:
        ConfigurationError: an interface does not exist.
    """
    bridge = settings.bridge
    if not bridge:
        return [[]] if settings.hub == "serve" else []
    known = [name for _, name in socket.if_nameindex()]
    for name in bridge:
        if name not in known:
            problem = f"this host has no such interface, or not yet; it has {', '.join(known)}"
            raise ConfigurationError(where=f"bridge {name}", problem=problem)
    networks = [[name] for name in dict.fromkeys(bridge)]
    here = loopback_interface()
    if here and here not in bridge:
        networks[0].append(here)
    return networks


def _check_bridged(bridge: Sequence[str], links: Links) -> None:
    """Raises ConfigurationError if no container can connect through one of the interfaces.

    An endpoint that this container cannot reach itself may be flooded by strangers; the bridge starts nevertheless.
    """
    if not bridge or any(own.everywhere for own in links.listen):
        return
    heard = {str(own): links.interfaces(str(own)) for own in links.listen}
    silent = [endpoint for endpoint, names in heard.items() if not names]
    if silent:
        _logger.warning("%s cannot be reached from here, so its interface is not checked", ", ".join(silent))
        return
    for name in bridge:
        if not any(name in names for names in heard.values()):
            problem = (
                f"nothing listens on it, only on {', '.join(map(str, links.listen))}; add an address of {name} to "
                f"TRADE_LISTEN (in a gateway file: listen), or {links.listen[0].protocol}/0.0.0.0:PORT"
            )
            raise ConfigurationError(where=f"bridge {name}", problem=problem)
