"""The identity of a container and the networks it may reach; every default stays on this host."""

import difflib
import logging
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import Final
from urllib.parse import SplitResult, urlsplit

from trade._security.certificates import Certificate
from trade._security.policy import EVERYTHING
from trade.default_system import account_home, account_name, chosen_settings, default_system
from trade.errors import ConfigurationError
from trade.protocol.keys import as_chunk, is_chunk
from trade.protocol.samples import STEPS_HZ
from trade.transport.endpoints import Endpoint, dialled_from_here

_logger = logging.getLogger("trade")
_VARIABLES: Final = (
    "TRADE_SYSTEM",
    "TRADE_IDENTITY",
    "TRADE_CODE",
    "TRADE_CONTAINER",
    "TRADE_LISTEN",
    "TRADE_CONNECT",
    "TRADE_CREDENTIALS",
    "TRADE_TLS",
    "TRADE_BRIDGE",
    "TRADE_HUB",
    "TRADE_INSECURE_LAN",
    "TRADE_LOCAL_PATH",
    "TRADE_LOCK",
    "TRADE_INSTANTIABLE",
    "TRADE_POLICY",
    "TRADE_RUNTIME_DIR",
    "TRADE_STATE_DIR",
    "TRADE_TRACE",
    "TRADE_OTLP",
    "TRADE_AUDIT",
    "TRADE_AUDIT_READS",
    "TRADE_AUDIT_KEEP_DAYS",
    "TRADE_AUDIT_KEEP_ROWS",
    "TRADE_METRICS",
    "TRADE_HOOK_LIMIT_S",
)
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_HUB: Final = ("auto", "off", "serve")
_HOOK_LIMIT_S: Final = 0.1
LONGEST_HOOK_S: Final = 60.0
_KEEP_DAYS: Final = 90
_KEEP_ROWS: Final = 10_000_000
_MOST_KEPT: Final = 1_000_000_000
_CERTIFY: Final = "set TRADE_TLS to the folder that trade pki issue made"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The settings of a container; ``Settings.read`` fills in the environment and the defaults.

    Raises:
        ConfigurationError: a name is invalid in a key, or the settings would reach beyond this host by accident.
    """

    system: str
    """The system id: containers of other systems are invisible."""
    identity: str
    """The identity that the container's messages carry."""
    container: str
    """Name of the container."""
    listen: tuple[str, ...] = ()
    """Endpoints such as ``tcp/127.0.0.1:7450``; none: any free port of the loopback interface."""
    connect: tuple[str, ...] = ()
    """Endpoints of other containers; none: the containers of this system on this host."""
    credentials: tuple[str, str] | None = field(default=None, repr=False)
    """User and password of the whole system; none: a secret that this user's containers on this host share."""
    tls: Path | None = None
    """A folder with ``ca.pem``, ``cert.pem`` and ``key.pem``, as ``trade pki issue`` makes it: the links are encrypted,
    both ends show certificates of one authority, and the identity is the certificate's common name. Replaces the
    credentials; all endpoints must be ``tls/HOST:PORT``."""
    insecure_lan: bool = False
    """Laboratories only: reach a network without certificates, without encryption, without a policy."""
    policy: Path | None = None
    """File of the access policy; none: every identity in the system may do everything."""
    bridge: tuple[str, ...] = ()
    """Network interfaces such as ``eth0``: carry messages between the containers of these networks, which need no route
    to each other. It has to listen on each; one interface is enough if it dials another bridge. Everything of the
    system crosses unless ``exports`` limits it."""
    exports: Mapping[str, tuple[str, ...]] | None = None
    """For each interface of the bridge, the groups of its network that others see and call; none: everything."""
    stream_hz: Mapping[str, Mapping[str, float]] = field(default_factory=dict[str, Mapping[str, float]])
    """For each interface of the bridge and exported group: the highest rate at which others receive its streams, one of
    1, 2, 5, 10, 20, 50, 100, 200 and 500 samples a second; without a limit: the rate they request."""
    hub: str = "auto"
    """``auto``: attach to the hub of this host, if one runs and ``listen``, ``connect`` and ``bridge`` are empty: one
    link instead of one to each container. ``off``: do not attach. ``serve``: be the hub of this host."""
    explicit_system: bool = False
    lock: str = ""
    """A lock that the parent process holds for this one; see `Lock.environment`."""
    instantiable: tuple[str, ...] = ()
    """Classes that other containers may create objects of here, such as ``mypkg.vision:Camera`` or ``mypkg.*``."""
    code: tuple[str, ...] = ()
    """SHA-256 of the archives of code that the container takes from others, in hexadecimal digits."""
    state_dir: Path | None = None
    """Folder for what must outlive a process, such as open e-stops; none: nothing is kept."""
    estop_dirs: tuple[Path, ...] = ()
    """Further folders of that kind, with each open e-stop, too: a process with another ``HOME`` finds it there."""
    trace: bool = False
    """Trace calls from the start; see `Container.set_tracing`."""
    otlp: str = ""
    """URL of a collector of spans, such as ``http://127.0.0.1:4318``; none: spans are not exported. Requires the extra
    ``trade-core[otel]``."""
    audit: Path | None = None
    """Folder for the audit record: calls, locks, stops, refusals and configuration changes, with their callers; none:
    no record is kept."""
    audit_reads: bool = False
    """Record calls of services that only read, too."""
    audit_keep_days: int = _KEEP_DAYS
    """How many days rows are kept; the newest 10,000 rows stay in any case."""
    audit_keep_rows: int = _KEEP_ROWS
    """How many rows are kept, some 350 bytes each."""
    metrics: str = ""
    """Where to serve ``/metrics`` for Prometheus, such as ``127.0.0.1:9464``; none: not served. Requires the extra
    ``trade-core[metrics]``."""
    local_path: bool = True
    """Make and take calls within this host on Unix sockets; false: all calls take the transport, which is slower."""
    hook_limit_s: float = _HOOK_LIMIT_S
    """How long one hook may delay a call of a service of this container, in seconds, at most 60; all hooks of one side
    together two and a half times as long."""

    def __post_init__(self) -> None:
        for what, text in (("system", self.system), ("identity", self.identity), ("container", self.container)):
            if not is_chunk(text) or text.strip(".") == "":  # the system's name is also that of a folder
                problem = f"{text!r} is no name for a {what}; use letters, digits, . _ - (at most 80)"
                raise ConfigurationError(where=what, problem=problem)
        self._check_collector(urlsplit(self.otlp))
        self._check_kept()
        self._check_metrics()
        self._check_code()
        self._check_choices()
        certificate = self.certificate()
        for endpoint in self.listen:
            self._check_reach(f"listen {endpoint}", Endpoint.read(endpoint))
            self._check_governed(f"listen {endpoint}", Endpoint.read(endpoint))
        if certificate is not None:
            for endpoint in self.listen or ("tls/127.0.0.1:0",):
                certificate.check_is_for(Endpoint.read(dialled_from_here(Endpoint.read(endpoint))).host)
        if self.credentials is not None and not _can_be_stored(*self.credentials):
            problem = "user and password must be printable, without spaces around them, and the user without a colon"
            raise ConfigurationError(where="credentials", problem=problem)
        for endpoint in self.connect:
            self.check_may_dial(endpoint)
        if len(set(self.bridge)) == 1 and not self.connect and self.hub != "serve":
            problem = "joins networks, and this is only one; name a second interface, or connect to another bridge"
            raise ConfigurationError(where=f"bridge {self.bridge[0]}", problem=problem)
        self._check_exports()

    def _check_choices(self) -> None:
        if not 0 < self.hook_limit_s <= LONGEST_HOOK_S:
            problem = f"must be above 0 and at most {LONGEST_HOOK_S:g} seconds, not {self.hook_limit_s:g}"
            raise ConfigurationError(where="TRADE_HOOK_LIMIT_S", problem=problem)
        if self.hub not in _HUB:
            raise ConfigurationError(where="TRADE_HUB", problem=f"{self.hub!r} is none of {', '.join(_HUB)}")

    def _check_metrics(self) -> None:
        if not self.metrics:
            return
        try:
            place = Endpoint.read(f"tcp/{self.metrics}")
        except ConfigurationError:
            problem = f"{self.metrics!r} is no HOST:PORT; write 127.0.0.1:9464"
            raise ConfigurationError(where="TRADE_METRICS", problem=problem) from None
        if not (place.loopback or self.insecure_lan):
            problem = (
                "any client there could read the refusals, as it needs no authentication and is not encrypted; write "
                f"127.0.0.1:{place.port}, and put a proxy that does both in front"
            )
            raise ConfigurationError(where="TRADE_METRICS", problem=problem)

    def _check_code(self) -> None:
        for sha256 in self.code:
            if not _SHA256.fullmatch(sha256):
                problem = f"{sha256!r} is no SHA-256; write the 64 hexadecimal digits that `trade code PATH` shows"
                raise ConfigurationError(where="TRADE_CODE", problem=problem)

    def _check_kept(self) -> None:
        for name, value in (("DAYS", self.audit_keep_days), ("ROWS", self.audit_keep_rows)):
            if not 1 <= value <= _MOST_KEPT:
                problem = f"must be from 1 to {_MOST_KEPT}, not {value}"
                raise ConfigurationError(where=f"TRADE_AUDIT_KEEP_{name}", problem=problem)

    def _check_exports(self) -> None:
        if self.exports is not None and set(self.exports) != set(self.bridge):
            problem = f"must name the interfaces of the bridge, {', '.join(self.bridge) or 'none'}, each once"
            raise ConfigurationError(where=f"exports of {', '.join(self.exports)}", problem=problem)
        for name, limits in self.stream_hz.items():
            check_stream_hz(limits, (self.exports or {}).get(name, ()), f"stream_hz of {name}")

    def check_may_dial(self, endpoint: str) -> None:
        """S21: raises ConfigurationError if an endpoint would reach a network by accident."""
        self._check_reach(f"connect {endpoint}", Endpoint.read(endpoint))

    def _check_reach(self, where: str, endpoint: Endpoint) -> None:
        problem = self._refused_plain(endpoint) if self.tls is None else self._refused_certified(endpoint)
        if problem:
            raise ConfigurationError(where=where, problem=problem)

    def _check_collector(self, url: SplitResult) -> None:
        if not self.otlp:
            return
        if url.scheme not in ("http", "https") or not url.hostname:
            problem = f"{self.otlp!r} is no URL of a collector; write http://127.0.0.1:4318"
            raise ConfigurationError(where="TRADE_OTLP", problem=problem)
        if url.scheme == "http" and not (Endpoint("tcp", url.hostname, 0).loopback or self.insecure_lan):
            problem = f"the callers of services would cross the network unencrypted; write https://{url.netloc}"
            raise ConfigurationError(where="TRADE_OTLP", problem=problem)

    def _refused_plain(self, endpoint: Endpoint) -> str:
        if endpoint.protocol == "tls":
            return f"requires certificates, and TRADE_TLS is not set: {_CERTIFY}"
        if endpoint.loopback:
            return ""
        if not self.insecure_lan:
            return f"beyond loopback requires certificates: {_CERTIFY}, and tls/{endpoint.host}:{endpoint.port}"
        if not (self.explicit_system and self.credentials):
            what = "TRADE_INSECURE_LAN needs an explicit system id and credentials, too"
            return f"{what}: set TRADE_SYSTEM and TRADE_CREDENTIALS=user:password"
        return ""

    def _refused_certified(self, endpoint: Endpoint) -> str:
        if endpoint.protocol != "tls":
            return f"a container with a certificate links only by tls: it must be tls/{endpoint.host}:{endpoint.port}"
        if endpoint.host.startswith("["):
            return "the transport does not link with certificates at IPv6 addresses; use an IPv4 address or a name"
        if endpoint.rest:  # it could switch off the security of a link
            return f"allows nothing after the port; leave out {endpoint.rest}"
        if not (endpoint.loopback or self.explicit_system):
            return "reaching a network needs an explicit system id: set TRADE_SYSTEM"
        return ""

    def _check_governed(self, where: str, endpoint: Endpoint) -> None:
        if not (endpoint.loopback or self.policy or self.insecure_lan):
            problem = (
                "listening beyond loopback needs a policy, and none is loaded; set TRADE_POLICY (in a gateway file: "
                "policy), or listen on "
                f"{endpoint.protocol}/127.0.0.1:PORT"
            )
            raise ConfigurationError(where=where, problem=problem)

    def certificate(self) -> Certificate | None:
        """The current certificate in the folder; raises ConfigurationError if it is invalid, or another identity's."""
        if self.tls is None:
            return None
        if self.credentials is not None:
            problem = "certificates replace them; leave out TRADE_CREDENTIALS or TRADE_TLS"
            raise ConfigurationError(where="credentials", problem=problem)
        certificate = Certificate.read(self.tls)
        if certificate.identity != self.identity:
            problem = (
                f"{self.identity!r} contradicts {self.tls / 'cert.pem'}, which is of {certificate.identity!r}; "
                "leave out TRADE_IDENTITY, or name the folder of that one"
            )
            raise ConfigurationError(where="identity", problem=problem)
        return certificate

    @classmethod
    def read(
        cls,
        *,
        system: str | None = None,
        identity: str | None = None,
        container: str | None = None,
        listen: Sequence[str] | None = None,
        connect: Sequence[str] | None = None,
        credentials: tuple[str, str] | None = None,
        tls: str | Path | None = None,
        insecure_lan: bool | None = None,
        bridge: Sequence[str] | None = None,
        hub: str | None = None,
        exports: Mapping[str, Sequence[str]] | None = None,
        stream_hz: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
        policy: Path | None = None,
        instantiable: Sequence[str] | None = None,
        audit: Path | None = None,
        metrics: str | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> "Settings":
        """Settings from arguments, else from the environment, else the defaults.

        The environment has ``TRADE_SYSTEM``, ``TRADE_IDENTITY``, ``TRADE_CONTAINER``, ``TRADE_LISTEN`` and
        ``TRADE_CONNECT`` (comma-separated), ``TRADE_CREDENTIALS`` (``user:password``), ``TRADE_TLS`` (a folder),
        ``TRADE_POLICY`` (a file), ``TRADE_INSECURE_LAN`` (``1``), ``TRADE_BRIDGE`` (comma-separated), ``TRADE_HUB``
        (``auto``, ``off`` or ``serve``), ``TRADE_LOCK`` (set by ``trade lock``), ``TRADE_INSTANTIABLE`` and
        ``TRADE_CODE`` (comma-separated), ``TRADE_TRACE`` (``1``), ``TRADE_OTLP`` (a URL), ``TRADE_AUDIT`` (a folder),
        ``TRADE_AUDIT_READS`` (``1``), ``TRADE_AUDIT_KEEP_DAYS``, ``TRADE_AUDIT_KEEP_ROWS``, ``TRADE_METRICS``
        (``HOST:PORT``), ``TRADE_HOOK_LIMIT_S`` (seconds),
        ``TRADE_LOCAL_PATH`` (``0`` switches the local path off),
        ``TRADE_RUNTIME_DIR`` and ``TRADE_STATE_DIR`` (else the user's folder for state).
        A warning is logged for other variables that begin with ``TRADE_``. If neither the arguments nor the environment
        name a system, the choice of ``trade use`` comes before the defaults.
        """
        if environment is None:
            environment = os.environ
            if not system and not environment.get("TRADE_SYSTEM"):
                environment = {**chosen_settings(environment), **environment}
        _warn_of_unknown(environment)
        named = system or environment.get("TRADE_SYSTEM") or None
        folder = tls or environment.get("TRADE_TLS")
        certified = Path(folder).absolute() if folder else None
        return cls(
            system=named or default_system(),
            identity=identity or environment.get("TRADE_IDENTITY") or _who(certified),
            container=container or environment.get("TRADE_CONTAINER") or _program(),
            listen=tuple(_split(environment, "TRADE_LISTEN") if listen is None else listen),
            connect=tuple(_split(environment, "TRADE_CONNECT") if connect is None else connect),
            credentials=credentials or _credentials(environment.get("TRADE_CREDENTIALS")),
            tls=certified,
            insecure_lan=environment.get("TRADE_INSECURE_LAN") == "1" if insecure_lan is None else insecure_lan,
            bridge=tuple(_split(environment, "TRADE_BRIDGE") if bridge is None else bridge),
            hub=hub or environment.get("TRADE_HUB") or "auto",
            exports=None if exports is None else {name: tuple(groups) for name, groups in exports.items()},
            stream_hz=stream_hz,
            policy=policy or _path(environment.get("TRADE_POLICY")),
            explicit_system=named is not None,
            lock=environment.get("TRADE_LOCK", ""),
            instantiable=tuple(_split(environment, "TRADE_INSTANTIABLE") if instantiable is None else instantiable),
            code=tuple(_split(environment, "TRADE_CODE")),
            state_dir=_state_dir(environment),
            estop_dirs=_estop_dirs(environment),
            trace=environment.get("TRADE_TRACE") == "1" or bool(environment.get("TRADE_OTLP")),
            otlp=environment.get("TRADE_OTLP", ""),
            audit=audit or _path(environment.get("TRADE_AUDIT")),
            audit_reads=environment.get("TRADE_AUDIT_READS") == "1",
            audit_keep_days=_number(environment, "TRADE_AUDIT_KEEP_DAYS", _KEEP_DAYS),
            audit_keep_rows=_number(environment, "TRADE_AUDIT_KEEP_ROWS", _KEEP_ROWS),
            metrics=environment.get("TRADE_METRICS", "") if metrics is None else metrics,
            local_path=environment.get("TRADE_LOCAL_PATH") != "0",
            hook_limit_s=_seconds(environment, "TRADE_HOOK_LIMIT_S", _HOOK_LIMIT_S),
        )


def check_stream_hz(limits: Mapping[str, float], exported: Sequence[str], where: str) -> None:
    """Raises ConfigurationError: invalid limits, or limits without effect."""
    for group, hz in limits.items():
        if group not in exported:
            problem = f"{group!r} is not exported as such; there is {', '.join(exported) or 'nothing'}"
            raise ConfigurationError(where=where, problem=problem)
        if hz not in STEPS_HZ[:-1]:
            problem = f"{hz:g} for {group} is none of {', '.join(map(str, STEPS_HZ[:-1]))} a second"
            raise ConfigurationError(where=where, problem=problem)
        wider = [one for one in exported if group.startswith(f"{one}.") or (one == EVERYTHING != group)]
        above = next((one for one in wider if limits.get(one, inf) > hz), None)
        if above is not None:
            problem = f"{group} is exported with all of {above!r} as well, which lets more pass; limit that, too"
            raise ConfigurationError(where=where, problem=problem)


def _warn_of_unknown(environment: Mapping[str, str]) -> None:
    for name in sorted(environment):
        if name.startswith("TRADE_") and name not in _VARIABLES:
            near = difflib.get_close_matches(name, _VARIABLES, n=1, cutoff=0.8)
            hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(_VARIABLES)}"
            _logger.warning("TRADE does not know the environment variable %s; %s", name, hint)


def _path(named: str | None) -> Path | None:
    return Path(named) if named else None


def _number(environment: Mapping[str, str], name: str, default: int) -> int:
    text = environment.get(name)
    try:
        return int(text) if text else default
    except ValueError:
        raise ConfigurationError(where=name, problem=f"{text!r} is no whole number") from None


def _seconds(environment: Mapping[str, str], name: str, default: float) -> float:
    text = environment.get(name)
    try:
        return float(text) if text else default
    except ValueError:
        raise ConfigurationError(where=name, problem=f"{text!r} is no number of seconds") from None


def _state_dir(environment: Mapping[str, str]) -> Path | None:
    named = environment.get("TRADE_STATE_DIR")
    if named:
        return Path(named)
    base = environment.get("LOCALAPPDATA" if os.name == "nt" else "XDG_STATE_HOME")
    try:
        return Path(base) / "trade" if base else Path.home() / ".local" / "state" / "trade"
    except RuntimeError:  # no home directory
        return None


def _estop_dirs(environment: Mapping[str, str]) -> tuple[Path, ...]:
    home = None if environment.get("TRADE_STATE_DIR") else account_home()
    found = () if home is None else (home / ".local" / "state" / "trade",)
    return tuple(folder for folder in found if folder != _state_dir(environment))


def _split(environment: Mapping[str, str], name: str) -> list[str]:
    return [part.strip() for part in environment.get(name, "").split(",") if part.strip()]


def _credentials(text: str | None) -> tuple[str, str] | None:
    if not text:
        return None
    user, colon, password = text.partition(":")
    if not (user and colon and password):
        raise ConfigurationError(where="TRADE_CREDENTIALS", problem="must be user:password")
    return user, password


def _can_be_stored(user: str, password: str) -> bool:
    """Whether the transport's file of users can hold them."""
    fit = all(text and text.isprintable() and text == text.strip() for text in (user, password))
    return fit and ":" not in user


def _who(certified: Path | None) -> str:
    return account_name() if certified is None else Certificate.read(certified).identity


def _program() -> str:
    name = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] else ""
    return as_chunk(f"{name if name not in ('', '-c', '-m', '__main__') else 'python'}-{os.getpid()}")
