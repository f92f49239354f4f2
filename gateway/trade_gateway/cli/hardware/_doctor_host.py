"""Checks of ``trade doctor`` on the host. The paths that a check reads are its arguments."""

import grp
import os
import pwd
import socket
import subprocess
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Final, Literal

from msgspec import Struct

from trade import Container
from trade.hub_file import HubFile
from trade_drivers import AnyDriver, load_driver
from trade_gateway.process._real_time import PRIORITY, refusal

_LATENCIES: Final = Path("/sys/bus/usb-serial/devices")
_LATEST_MS: Final = 2
_CLOCK: Final = ("timedatectl", "show", "--property=NTPSynchronized", "--value")
_MAPS: Final = Path("/proc/self/maps")
_IN_CONTAINERS: Final = (Path("/.dockerenv"), Path("/run/.containerenv"))
"""Files that docker and podman put into each container."""
_SOON: Final = timedelta(days=2)
_PATIENCE_S: Final = 5.0
_MULTICAST: Final = "239.255.71.68"
"""A multicast address of the site's own scope; only this check listens there."""


class Finding(Struct, frozen=True, kw_only=True):
    """The result of one check."""

    level: Literal["ok", "warning", "error"]
    about: str
    text: str
    fix: str = ""
    """What to do about a problem."""


def ports(paths: Sequence[str], named: Sequence[str] = ()) -> Iterator[Finding]:
    """Checks whether this user may open the serial ports.

    Args:
        paths: the ports that the system lists.
        named: the ports of the robot file, which are checked with their devices.
    """
    if not paths:
        others = f"; the robot file names {len(named)}, checked below" if named else ""
        yield Finding(level="ok", about="serial ports", text=f"no adapter is plugged in{others}")
    for path in paths:
        if os.access(path, os.R_OK | os.W_OK):
            yield Finding(level="ok", about=path, text="may be opened")
        else:
            group = _group(path)
            fix = f"sudo usermod -aG {group} $USER, then log out and in again"
            yield Finding(level="error", about=path, text=f"may be opened only by root and group {group}", fix=fix)


def _group(path: str) -> str:
    number = Path(path).stat().st_gid
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def latencies(folder: Path = _LATENCIES) -> Iterator[Finding]:
    """Checks how long USB adapters delay received bytes."""
    for timer in sorted(folder.glob("*/latency_timer")):
        about, ms = timer.parent.name, int(timer.read_text(encoding="ascii"))
        if ms <= _LATEST_MS:
            yield Finding(level="ok", about=about, text=f"delivers received bytes within {ms} ms")
            continue
        text = f"delays received bytes by up to {ms} ms, so that a cycle takes that long"
        fix = f"echo 1 | sudo tee {timer}; permanently: the udev rules of `trade install`"
        yield Finding(level="warning", about=about, text=text, fix=fix)


def libraries(names: Sequence[str], *, needed: bool) -> Iterator[Finding]:
    """Checks whether the vendor libraries of drivers are installed."""
    for name in names:
        missing = load_driver(name, "driver", AnyDriver).missing()
        if not missing:
            yield Finding(level="ok", about=f"driver {name}", text="its libraries are installed")
            continue
        text, fix = f"needs {', '.join(missing)}", f'pip install "trade-drivers[{name}]"'
        yield Finding(level="error" if needed else "warning", about=f"driver {name}", text=text, fix=fix)


def clock(command: Sequence[str] = _CLOCK) -> Iterator[Finding]:
    """Checks whether the clock is synchronised; certificates, logs and traces need it, motion does not."""
    try:
        ran = subprocess.run(  # noqa: S603 - ours
            command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False
        )
        answer = ran.stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        answer = ""
    fix = "sudo timedatectl set-ntp true; without a network, let one host serve the time to the others (chrony)"
    if answer == "yes":
        yield Finding(level="ok", about="clock", text="is synchronised")
    elif answer == "no":
        text = "is not synchronised: certificates may seem invalid, and the logs of hosts do not match"
        yield Finding(level="warning", about="clock", text=text, fix=fix)
    else:
        text = "it is unknown whether it is synchronised"
        yield Finding(level="warning", about="clock", text=text, fix="compare `date -u` on all hosts")


def real_time(in_containers: Sequence[Path] = _IN_CONTAINERS) -> Iterator[Finding]:
    """Checks whether this user's drivers may run in real time."""
    if why := refusal():
        text = f"{why}; on a busy computer, bus cycles are late by milliseconds"
        fix = _container_permission() if any(file.exists() for file in in_containers) else _user_permission()
        yield Finding(level="warning", about="real time", text=text, fix=fix)
        return
    yield Finding(level="ok", about="real time", text="drivers may run before ordinary programs (SCHED_FIFO)")


def _container_permission() -> str:
    right = "--cap-add SYS_NICE" if os.getuid() == 0 else f"--ulimit rtprio={PRIORITY}"
    return f"start the container with {right} --ulimit memlock=-1"


def _user_permission() -> str:
    user = pwd.getpwuid(os.getuid()).pw_name
    lines = f'"{user} - rtprio {PRIORITY}" and "{user} - memlock unlimited"'
    return f"put {lines} into /etc/security/limits.d/trade.conf, then log in again"


def waits(maps: Path = _MAPS) -> Iterator[Finding]:
    """Checks whether the timeouts of this Python are independent of clock changes.

    CPython waits for locks with `sem_clockwait` if its C library had that at build time (glibc 2.30), else by the
    wall clock.
    """
    loaded = {Path(line.split(maxsplit=5)[-1]) for line in maps.read_text().splitlines() if "/" in line}
    pythons = [path for path in loaded if "python" in path.name and path.is_file()]
    if any(b"sem_clockwait" in path.read_bytes() for path in pythons):
        yield Finding(level="ok", about="waits", text="end in time even if the clock is set")
        return
    text = "end late by as much as the clock is set back meanwhile, including those of locks and drivers"
    fix = "use the distribution's Python, or a newer build; else set the clock before you start the robot"
    yield Finding(level="warning", about="waits", text=text, fix=fix)


def certificate(folder: Path, now: datetime | None = None) -> Iterator[Finding]:
    """Checks whether the certificate of this user's containers is valid, and for how long."""
    from cryptography import x509  # noqa: PLC0415 - loads what others do not need

    path, now = folder / "cert.pem", now or datetime.now(timezone.utc)
    fix = f"run `trade pki issue NAME` on the authority's host, and copy the files that it made to {folder}"
    try:
        found = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as bad:
        yield Finding(level="error", about=str(path), text=f"cannot be read: {bad}", fix=fix)
        return
    begins, ends = found.not_valid_before_utc, found.not_valid_after_utc
    if now < begins:
        text = f"is valid only from {begins:%Y-%m-%d %H:%M} UTC"
        yield Finding(level="error", about=str(path), text=text, fix="set the clock of this host")
    elif now > ends:
        yield Finding(level="error", about=str(path), text=f"expired on {ends:%Y-%m-%d %H:%M} UTC", fix=fix)
    elif ends - now < _SOON:
        yield Finding(level="warning", about=str(path), text=f"expires on {ends:%Y-%m-%d %H:%M} UTC", fix=fix)
    else:
        yield Finding(level="ok", about=str(path), text=f"is valid until {ends:%Y-%m-%d}")


def multicast(group: str = _MULTICAST, patience_s: float = 1.0) -> Iterator[Finding]:
    """Checks whether UDP multicast works on this host, which discovery on a network needs."""
    fix = "allow UDP multicast in the firewall, or name endpoints in TRADE_CONNECT instead"
    try:
        with _datagrams() as ear, _datagrams() as mouth:
            ear.bind(("", 0))
            ear.settimeout(patience_s)
            anywhere = socket.inet_aton(group) + socket.inet_aton("0.0.0.0")  # noqa: S104 - joins, does not listen
            ear.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, anywhere)
            mouth.sendto(b"trade doctor", (group, ear.getsockname()[1]))
            ear.recv(64)
    except OSError as bad:
        text = f"multicast datagrams do not arrive ({bad}); discovery on a network needs them"
        yield Finding(level="warning", about="multicast", text=text, fix=fix)
    else:
        yield Finding(level="ok", about="multicast", text="datagrams are sent and received")


def _datagrams() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def in_sight(member: Container, system: str) -> Iterator[Finding]:
    """Lists the containers of the system that are visible from here."""
    reachability = member.reachability(limit_s=_PATIENCE_S if member.settings.connect else 0)
    for endpoint, why in reachability.unreached.items():
        fix = f"the text says what may be wrong; else correct {reachability.source}"
        text = f"no container answers there ({reachability.source}): {why}"
        yield Finding(level="error", about=endpoint, text=text, fix=fix)
    yield from _hub(HubFile(system))
    others = sorted(one.name for one in member.containers() if one.epoch != member.address.epoch)
    about = f"system {system}"
    for sentence in member.beyond(wait_s=_PATIENCE_S if member.settings.connect else 0):
        fix = "make an address of it reachable from here; until then, only stops of its groups get there"
        yield Finding(level="warning", about=about, text=sentence, fix=fix)
    yield from _moved(member)
    if others:
        yield Finding(level="ok", about=about, text=f"visible: {', '.join(others)}")
        return
    if reachability.unreached:
        return
    fix = "`trade up ROBOT.toml` starts one; another host needs the same TRADE_SYSTEM, and TRADE_CONNECT or discovery"
    yield Finding(level="ok", about=about, text="no container is visible", fix=fix)


def _moved(member: Container) -> Iterator[Finding]:
    """Checks whether containers are at other addresses than at their start."""
    asked = [handle for handle in member.everywhere("network").handles if not handle.local]
    for outcome in member.call_all(asked):
        if outcome.ok and outcome.result.moved:
            text = (
                f"its host has other addresses than when it started; it listens on {', '.join(outcome.result.listens)}"
            )
            fix = "dial its host by name in TRADE_CONNECT, or turn discovery on: both follow its addresses"
            yield Finding(level="warning", about=outcome.handle.container, text=text, fix=fix)


def _hub(file: HubFile) -> Iterator[Finding]:
    """Checks whether the hub of this host runs, if there was one."""
    if (hub := file.running()) is not None:
        yield Finding(level="ok", about="hub", text=f"runs at {hub.endpoint}, as {hub.identity}")
    elif file.last() is not None:
        text = "has ended: the containers that were attached to it are not visible"
        yield Finding(level="warning", about="hub", text=text, fix=f"trade hub; or remove {file.path} if there is none")
