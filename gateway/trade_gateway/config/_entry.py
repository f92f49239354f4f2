"""The table of one container: what it runs, and how."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from msgspec import Meta, Struct

LOCAL: Final = "local"
KINDS: Final = ("robot", "gateway", "providers", "rules", "http", "ros", "record", "program")
"""The keys that set what a container runs; a table has one of them."""
ONLY_WITH: Final[Mapping[str, Sequence[str]]] = {
    "sim": ("robot",),
    "without": ("robot",),
    "allow": ("providers",),
    "env": ("program",),
    "folder": ("program", "providers"),
    "announces": ("program",),
    "health": ("program",),
    "grace_s": ("program",),
    "log_mb": ("program",),
}

_Text = Annotated[str, Meta(min_length=1)]


class ObjectSpec(
    Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"class_": "class"}, omit_defaults=True
):
    """An object to create in a container and offer as services."""

    class_: Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_][\w.]*$")]
    """The class, such as ``mypkg.vision:Camera``."""
    groups: list[_Text] = []
    args: list[Any] | dict[str, Any] = []
    """Arguments of its constructor, by position or by name."""


class HealthSpec(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """A command whose exit code 0 is a program's sign of life."""

    command: Annotated[list[_Text], Meta(min_length=1)]
    every_s: Annotated[float, Meta(ge=0.1, le=3600)] = 5.0
    """The interval, in seconds."""
    within_s: Annotated[float, Meta(ge=0.05, le=600)] = 2.0
    """The longest time that the command may take, in seconds."""


class ContainerTable(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """One container. Paths are relative to the system file; those of another host are paths there."""

    host: _Text = LOCAL
    """``local``, or as for ssh: HOST or USER@HOST."""
    robot: str = ""
    """A robot file."""
    sim: bool = False
    """Simulate the robot's devices."""
    without: list[_Text] = []
    """Buses, cameras and sensors of the robot to leave out."""
    gateway: str = ""
    """A gateway file."""
    providers: list[ObjectSpec] | None = None
    """Objects to create in it; modules of this host may be beside the system file."""
    allow: list[_Text] = []
    """Further classes that others may create in it."""
    rules: str = ""
    """A rules file."""
    http: dict[str, Any] | None = None
    """An HTTP gateway; the product checks its table, as that of ``record``."""
    ros: str = ""
    """The file of a ROS bridge."""
    record: dict[str, Any] | None = None
    program: Annotated[list[_Text], Meta(min_length=1)] | None = None
    """Any program with its arguments. With a ``/`` its path is relative to the file, else it is looked up in PATH."""
    env: dict[str, str] = {}
    """Further variables of the program."""
    folder: str = ""
    """The program's working folder, or the folder of the modules of providers; by default the folder of the file."""
    announces: str = ""
    """The container that the program opens: its sign of life."""
    health: HealthSpec | None = None
    """A command that shows whether the program is healthy; without it and ``announces``, a process that runs is."""
    grace_s: Annotated[float, Meta(ge=0.1, le=15)] = 10.0
    """How long the program and its children have between SIGTERM and SIGKILL, in seconds."""
    log_mb: Annotated[float, Meta(ge=0.1, le=10_000)] = 10.0
    """The most that each of the program's two log files takes, in MB."""
    after: list[_Text] = []
    """Containers that must be up first."""
    tls: str = ""
    policy: str = ""
    audit: str = ""
    """Folder of its audit record."""
    metrics: str = ""
    """Where Prometheus finds its metrics: ``127.0.0.1:9464``."""
    connect: list[_Text] | None = None
    """Endpoints that it connects to; None: those of the system."""
    listen: list[_Text] = []
    command: _Text = "trade"
    """The path of ``trade`` on another host."""

    @property
    def kind(self) -> str:
        """The key that sets its kind; a checked file has exactly one."""
        return next(kind for kind in KINDS if getattr(self, kind) not in ("", None))

    @property
    def file(self) -> str:
        """The file of a robot, a gateway, rules or a ROS bridge."""
        return self.robot or self.gateway or self.rules or self.ros

    @property
    def is_local(self) -> bool:
        """Whether it runs on the host of `trade system`."""
        return self.host == LOCAL


INSIDE: Final[Mapping[str, type[Struct]]] = {
    "providers": ObjectSpec,
    "health": HealthSpec,
}
"""The type of the table under a key of an entry."""


class FileDefaults(Struct, frozen=True, kw_only=True):
    """Settings for all containers of a file."""

    system: str
    """The system id."""
    tls: str = ""
    """The default folder of certificates for containers of this host. ``policy`` and ``audit`` are defaults, too."""
    policy: str = ""
    audit: str = ""
    connect: Sequence[str] = ()
    environment: Mapping[str, str] = {}
    """Further variables of containers of this host, besides inherited ones."""
    inherited: Mapping[str, str] = os.environ


class ContainerSpec(NamedTuple):
    """A container, with the command that starts it."""

    name: str
    entry: ContainerTable
    words: Sequence[str]
    """The words after ``trade``; of a program, the program and its arguments."""
    environment: Mapping[str, str]
    """Variables besides those that are set anyway."""
    folder: Path = Path()
    """The working folder of a program."""
    health: str = ""
    """The path of its health command."""

    @property
    def files(self) -> list[str]:
        """The files that its host must have."""
        named = [self.environment[name] for name in ("TRADE_TLS", "TRADE_POLICY") if name in self.environment]
        return [*([self.entry.file] if self.entry.file else []), *named]
