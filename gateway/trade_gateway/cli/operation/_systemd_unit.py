"""The files of `trade install`: a systemd unit with only the rights that its gateway needs, and udev rules."""

import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct

from trade.transport.precedence import NICE
from trade_drivers import CanBus, Robot, SerialBus
from trade_gateway.process._real_time import PRIORITY

_COMES_AND_GOES: Final = re.compile(r"/dev/(serial/|tty(USB|ACM)\d)")
_HIDDEN: Final = tuple(map(Path, ("/home", "/root", "/run/user", "/tmp", "/var/tmp")))  # noqa: S108 - what the unit hides
_STATE: Final = Path("/var/lib/trade")
_LEAVES_S: Final = 35
"""How long the gateway and each container may take to shut down, in seconds: to stop a robot and save states."""


class HostResources(Struct, frozen=True):
    """The resources of the host that a gateway and its robots need."""

    serial: bool = False
    """Whether they need serial ports."""
    devices: tuple[str, ...] = ()
    """Devices as in DeviceAllow=."""
    can: bool = False
    """Whether they need CAN interfaces of the kernel."""
    real_time: bool = False
    """Whether drivers run in real time."""
    hub: bool = False
    """Whether the gateway is the hub of its host."""


def needs_of(robots: Iterable[Robot]) -> HostResources:
    """Returns the needs of robot files. Options of cameras and sensors that begin with ``/dev/`` are devices."""
    ports, others, can, drives = set[str](), set[str](), False, False
    for robot in robots:
        drives |= bool(robot.buses)
        for bus in robot.buses:
            match bus:
                case SerialBus():
                    ports.add(bus.port)
                case CanBus(interface="socketcan"):
                    can = True
                case CanBus() if bus.channel.startswith("/dev/"):
                    ports.add(bus.channel)
                case _:
                    pass
        for sense in (*robot.cameras, *robot.sensors):
            others |= {
                value for value in sense.options.values() if isinstance(value, str) and value.startswith("/dev/")
            }
    # An adapter may get another number when it is plugged in again, so its whole kind is allowed.
    kinds = ("char-ttyUSB", "char-ttyACM") if ports else ()
    fixed = {port for port in ports if not _COMES_AND_GOES.match(port)}
    return HostResources(serial=bool(ports), devices=(*kinds, *sorted(fixed | others)), can=can, real_time=drives)


def program_folders() -> list[Path]:
    """Returns the folders of the running Python and of its imports."""
    return [Path(sys.prefix), Path(sys.base_prefix), *(Path(one) for one in sys.path if Path(one).is_dir())]


def unit_text(
    gateway: Path,
    *,
    user: str,
    needs: HostResources,
    containers: int,
    program: Sequence[str],
    folders: Iterable[Path],
    records: Iterable[Path],
) -> str:
    """Returns the text of a unit for ``trade gateway``.

    Args:
        gateway: the gateway file, as an absolute path.
        user: the user it runs as.
        needs: what its robots need.
        containers: how many containers it supervises.
        program: the command ``trade``, with an absolute path.
        folders: folders that must be readable, as absolute paths.
        records: folders that must be writable besides its folder for state, as absolute paths.
    """
    shown = _outermost(filter(_is_hidden, folders))
    written = [folder for folder in _outermost(records) if not folder.is_relative_to(_STATE)]
    homes = [
        *(f"BindReadOnlyPaths={_quoted(str(folder))}" for folder in shown),
        *(f"BindPaths={_quoted(str(folder))}" for folder in written if _is_hidden(folder)),
    ]
    open_ = [f"ReadWritePaths={_quoted(str(folder))}" for folder in written if not _is_hidden(folder)]
    calls = [*(["sched_setscheduler"] if needs.real_time else []), *(["setpriority"] if needs.hub else [])]
    families = ["AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK", *(["AF_CAN"] if needs.can else [])]
    parts = {
        "FILE": _plain(str(gateway)),
        "COMMAND": " ".join(_quoted(word).replace("$", "$$") for word in (*program, "gateway", str(gateway))),
        "USER": user,
        "LEAVES": str(_LEAVES_S * (1 + containers)),
        "HOME": "\n".join([f"ProtectHome={'tmpfs' if homes else 'yes'}", *homes, *open_]),
        "DEVICES": _devices(needs),
        "FAMILIES": " ".join(families),
        "REALTIME": (_REAL_TIME if needs.real_time else "RestrictRealtime=yes") + (_AHEAD if needs.hub else ""),
        "CALLS": f"\nSystemCallFilter={' '.join(calls)}" if calls else "",
    }
    return re.sub(r"@([A-Z]+)@", lambda found: parts[found.group(1)], _UNIT)


def _devices(needs: HostResources) -> str:
    if not needs.devices:
        return "PrivateDevices=yes"
    group = ["SupplementaryGroups=dialout"] if needs.serial else []
    return "\n".join([*group, "DevicePolicy=closed", *(f"DeviceAllow={one} rw" for one in needs.devices)])


def hidden_in(path: Path) -> Path | None:
    """Returns the folder around a path that the unit hides from the service, or None."""
    return next((hidden for hidden in _HIDDEN if path.is_relative_to(hidden)), None)


def _is_hidden(folder: Path) -> bool:
    return hidden_in(folder) is not None


def _outermost(folders: Iterable[Path]) -> list[Path]:
    kept: list[Path] = []
    for folder in sorted(set(folders)):
        if not any(folder.is_relative_to(other) for other in kept):
            kept.append(folder)
    return kept


def _quoted(word: str) -> str:
    """Quotes one word of a list."""
    escaped = _plain(word).replace("\\", "\\\\").replace('"', '\\"')
    return escaped if re.fullmatch(r"[\w@%+=:,./-]+", escaped) else f'"{escaped}"'


def _plain(text: str) -> str:
    return text.replace("%", "%%")


_REAL_TIME: Final = f"""\
# Drivers run in real time; other processes do not request it.
LimitRTPRIO={PRIORITY}
LimitMEMLOCK=infinity"""

_AHEAD: Final = f"""
# The threads of the hub precede those of the containers that it serves.
LimitNICE={NICE}"""

_UNIT: Final = """\
[Unit]
Description=TRADE gateway of @FILE@
Wants=network-online.target
After=network-online.target time-sync.target
# Wait without limit for a late network or adapter.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart=@COMMAND@
ExecReload=/bin/kill -HUP $MAINPID
# Only the gateway gets the first signal: it shuts its containers down in order, each robot as its file says.
ExecStop=-/bin/sh -c 'kill -TERM "$MAINPID" && exec tail --pid="$MAINPID" -f /dev/null'
# Processes that remain, or all if the gateway dies or hangs, get SIGTERM at once, and SIGKILL only after this time:
# motors without their own watchdog would continue with their last command.
KillMode=control-group
TimeoutStopSec=@LEAVES@
WatchdogSec=30
WatchdogSignal=SIGTERM
Restart=on-failure
RestartSec=5

User=@USER@
StateDirectory=trade
StateDirectoryMode=0700
RuntimeDirectory=trade
RuntimeDirectoryMode=0700
Environment=TRADE_STATE_DIR=%S/trade TRADE_RUNTIME_DIR=%t/trade PYTHONUNBUFFERED=1
UMask=0077

NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
PrivateUsers=yes
ProtectSystem=strict
@HOME@
PrivateTmp=yes
@DEVICES@
ProtectProc=invisible
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
RestrictAddressFamilies=@FAMILIES@
RestrictNamespaces=yes
@REALTIME@
RestrictSUIDSGID=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
RemoveIPC=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources@CALLS@
SystemCallErrorNumber=EPERM
# Not restricted, and why:
# PrivateNetwork, IPAddressDeny: it forwards calls between networks; its policy restricts them.
# AF_NETLINK: the transport asks the kernel for the addresses of its interfaces.
# ProcSubset: `trade containers --load` reads the load and the memory of the host in /proc.
# RootDirectory: it runs the installed Python, and reads the files that its gateway file names.

[Install]
WantedBy=multi-user.target
"""

UDEV_RULES: Final = """\
# The system's own rules make the lasting names /dev/serial/by-id/...
ACTION=="remove", GOTO="trade_end"
# Serial adapters belong to the group dialout; ModemManager, which probes them for modems, must ignore them.
SUBSYSTEM=="tty", KERNEL=="ttyUSB[0-9]*|ttyACM[0-9]*", GROUP="dialout", MODE="0660"
SUBSYSTEM=="tty", KERNEL=="ttyUSB[0-9]*|ttyACM[0-9]*", ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"
# FTDI adapters delay received bytes by 16 ms by default, and a bus cycle takes as long.
SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
LABEL="trade_end"
"""
