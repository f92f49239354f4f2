"""The middleware's own functions as services, in group ``trade`` of every container."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from trade._calls.handle import Handle
from trade._discovery.dialer import Dialer
from trade._protocol.container_info import ContainerInfo
from trade._protocol.keys import CLOCK, DOMAIN, Address, ServiceKey
from trade._registry.constraints import Constraint, where
from trade._remote.ssh import start
from trade._services.decorator import service
from trade._services.withdrawn import WithdrawnInfo
from trade._settings import Settings
from trade._telemetry.load import LoadInfo, LoadMeter
from trade.errors import CannotStart, ConfigurationError, LinkStays, NoSuchService, TooManyServices


class _Withdrawn(Protocol):
    def take_off(self, key: ServiceKey) -> str: ...
    def put_back(self, provider: str, groups: str | Sequence[str] | None) -> list[ServiceKey]: ...
    def infos(self) -> list[WithdrawnInfo]: ...


class _Making(Protocol):
    def find(self, class_path: str) -> type: ...
    def make(self, kind: type, args: Sequence[Any] | Mapping[str, Any]) -> object: ...
    def offer(
        self, made: object, groups: Sequence[str], args: Sequence[Any] | Mapping[str, Any]
    ) -> tuple[Handle, ...]: ...
    def terminate(self, service: Handle) -> None: ...


class _Arriving(Protocol):
    def bring_back(
        self, class_path: str, args: Sequence[Any] | Mapping[str, Any], groups: tuple[str, ...], state: Any
    ) -> list[ServiceKey]: ...


class _Terminating(Protocol):
    def begin(self, reason: str, who: str, *, only_at_rest: bool = False) -> list[str]: ...


class _Member(Protocol):
    """The container the switches belong to."""

    address: Final[Address]
    meter: LoadMeter

    @property
    def reach(self) -> Dialer: ...
    @property
    def withdrawn(self) -> _Withdrawn: ...
    @property
    def making(self) -> _Making: ...
    @property
    def arriving(self) -> _Arriving: ...
    @property
    def terminating(self) -> _Terminating: ...
    @property
    def settings(self) -> Settings: ...
    def find(self, constraint: Constraint, *, wait_s: float = ...) -> Handle: ...
    def handle(self, key: ServiceKey) -> Handle: ...
    def containers(self) -> list[ContainerInfo]: ...
    def load_policy(self, path: str) -> None: ...


class System:
    """Switches of a running container: whom it is linked to, and whether it finds and is found.

    None of them disturbs calls under way, and each is a service in group ``trade`` of every container as well.
    """

    def __init__(self, member: Callable[[], _Member]) -> None:
        self._member = member

    def set_discovery(self, on: bool) -> None:
        """Look for containers of this system that broadcast, and link to each; off: what is linked stays linked.

        It looks as far as the container listens: on this host, or on its networks.
        """
        self._member().reach.set_discovery(on)

    def set_broadcast(self, on: bool) -> None:
        """Answer those who look for containers of this system."""
        self._member().reach.set_broadcast(on)

    def connect(self, endpoint: str) -> None:
        """Link to the container that listens there, and again whenever the link is lost.

        Args:
            endpoint: such as ``tcp/127.0.0.1:7450`` or ``tcp/robot.example:7450``; names are looked up at every try.

        Raises:
            CannotConnect: nobody there lets us in.
            ConfigurationError: no endpoint, or a network, with neither system id nor credentials (S21).
        """
        self._member().reach.connect(endpoint)

    def disconnect(self, endpoint: str) -> None:
        """Dial an endpoint no more.

        Args:
            endpoint: what was given to `connect`; the name of a container is understood, too.

        Raises:
            LinkStays: the link is there, and stays until one of its containers closes; it is dialled no more.
        """
        if any(info.name == endpoint for info in self.containers()):
            raise LinkStays(to=endpoint)
        self._member().reach.disconnect(endpoint)

    def containers(self) -> list[ContainerInfo]:
        """The containers of the system, this one included."""
        return self._member().containers()

    def load(self) -> LoadInfo:
        """How busy this container, its process and its host are."""
        return self._member().meter.read()

    def deregister(self, service: Handle) -> str:
        """Withdraw the provider of a service of this container, which keeps the object to register it again.

        Returns:
            The name to `register` it by. Handles of its services fail from now on.

        Raises:
            ConfigurationError: it is not registered here, or is the middleware's own.
        """
        member = self._member()
        home = service.key.address
        if home != member.address:
            problem = f"it belongs to another container, or to an earlier boot; call deregister of {home.container}"
            raise ConfigurationError(where=service.label, problem=problem)
        return member.withdrawn.take_off(service.key)

    def register(self, provider: str, groups: tuple[str, ...] | None = None) -> tuple[Handle, ...]:
        """Offer an object again that was deregistered through this container.

        Args:
            provider: the name that `deregister` returned.
            groups: other groups than before.

        Returns:
            Handles of its services; those from before stay dead.

        Raises:
            ConfigurationError: no such provider was deregistered, or a malformed group.
        """
        member = self._member()
        return tuple(member.handle(key) for key in member.withdrawn.put_back(provider, groups))

    def withdrawn(self) -> list[WithdrawnInfo]:
        """What `register` can offer again, by name."""
        return self._member().withdrawn.infos()

    def instantiate(
        self,
        class_path: str,
        args: Sequence[Any] | Mapping[str, Any] = (),
        groups: str | Sequence[str] = (),
        state: Any = None,
    ) -> tuple[Handle, ...]:
        """Make an object of a class and offer its services.

        Args:
            class_path: such as ``mypkg.vision:Camera``; the container's ``instantiable`` must allow it.
            args: for its constructor, in order or by name; plain data.
            groups: as for `register`.
            state: what another object of the class gave with ``save_state()``; this one takes it before anybody can
                call it, and moves nothing (S18). None: it begins anew.

        Returns:
            Handles of its services.

        Raises:
            NotInstantiable: the container's settings do not allow it; nothing was imported.
            NoSuchClass: there is no such class there.
            CannotInstantiate: its module or its constructor raised, or it does not take the state.
            ConfigurationError: nothing to offer, or a malformed group; what was made is closed again.
        """
        member = self._member()
        making, named = member.making, (groups,) if isinstance(groups, str) else tuple(groups)
        if state is not None:
            return tuple(member.handle(key) for key in member.arriving.bring_back(class_path, args, named, state))
        return making.offer(making.make(making.find(class_path), args), named, args)

    def start_container(
        self,
        host: str,
        name: str,
        *,
        allow: Sequence[str] = (),
        connect: Sequence[str] = (),
        command: Sequence[str] = ("trade",),
        environment: Mapping[str, str] | None = None,
        ssh_config: Path | None = None,
        wait_s: float = 10.0,
    ) -> ContainerInfo:
        """Start an empty container of this system on another host, and wait until it is seen here.

        The ``ssh`` program does it, with the keys and the configuration of this user. Nothing is asked of people, and
        only hosts whose key is known are talked to. What the container needs to come into the system (certificate,
        policy, credentials) is set up there, or given in ``environment``, which others on either host may see.

        Args:
            host: ``HOST`` or ``USER@HOST``, as for ssh.
            name: of the container.
            allow: classes that may be made in it.
            connect: endpoints it dials, as seen from there; none: what its environment says.
            command: what ``trade`` is there; a path, or more words.
            environment: variables for it.
            ssh_config: instead of the user's own.
            wait_s: how long it may take to be seen, once it is up there.

        Raises:
            CannotStart: with the reason, and what to do.
            ConfigurationError: what cannot be a host or a variable.
        """
        member = self._member()
        started = start(
            host,
            name,
            system=member.settings.system,
            allow=allow,
            connect=connect,
            command=command,
            environment=environment,
            ssh_config=ssh_config,
        )
        with contextlib.suppress(NoSuchService, TooManyServices):  # which one it is the epoch tells
            member.find(where(name=CLOCK, group=DOMAIN, container=name), wait_s=wait_s)
        found = next((info for info in self.containers() if info.epoch == started.epoch), None)
        if found is None:
            said = f"it is up there as process {started.pid}, and not seen here within {wait_s:g} s"
            remedy = "tell it whom to dial (connect=...), and give it the credentials or certificates of this system"
            raise CannotStart(host=host, container=name, reason="not seen", said=said, remedy=remedy)
        return found

    def terminate(self, service: Handle) -> None:
        """End a provider that `instantiate` made in this container: what it moves stops, then it is closed.

        ``close()`` of the object is called, if it has one.

        Raises:
            ConfigurationError: it was not made by this container, or has ended.
            DeviceFault: it could not be stopped; it is offered as before.
        """
        self._member().making.terminate(service)

    def terminate_container(self, reason: str = "", *, only_at_rest: bool = False, who: str = "itself") -> list[str]:
        """End this container: what moves stops, its services are withdrawn. Does not wait for its end.

        The process goes on, unless it is one of ``trade container``, ``trade up`` or ``trade gateway``.

        Args:
            reason: why, for people; it is logged.
            only_at_rest: not while something of it is locked or moves.
            who: asks for it; likewise.

        Returns:
            What could not be stopped, and why; it ends all the same.

        Raises:
            InUse: it was to end ``only_at_rest``, and something is locked or moves.
        """
        return self._member().terminating.begin(reason, who, only_at_rest=only_at_rest)

    def load_policy(self, path: str) -> None:
        """Go by another access policy, or by the same file as it is now; calls under way go on.

        Args:
            path: of the policy, as this container's host sees it.

        Raises:
            ConfigurationError: it is wrong, and says where; what was loaded before stays.
        """
        self._member().load_policy(path)


class SystemServices:
    """What every container offers about itself."""

    def __init__(self, system: System) -> None:
        self._system = system

    @service(effect="read")
    def clock(self) -> int:
        """Monotonic clock of this container, in nanoseconds; the basis of every expiry."""
        return time.monotonic_ns()

    @service(effect="read")
    def containers(self) -> list[ContainerInfo]:
        """The containers that this one knows of, itself included."""
        return self._system.containers()

    @service(effect="read")
    def load(self) -> LoadInfo:
        """How busy this container, its process and its host are."""
        return self._system.load()

    @service
    def deregister(self, service: Handle) -> str:
        """Withdraw the provider of a service of this container; returns the name to register it by again."""
        return self._system.deregister(service)

    @service
    def register(self, provider: str, groups: tuple[str, ...] | None = None) -> tuple[Handle, ...]:
        """Offer an object again that was deregistered through this container, in other groups if some are given."""
        return self._system.register(provider, groups)

    @service(effect="read")
    def withdrawn(self) -> list[WithdrawnInfo]:
        """What can be registered again, by name."""
        return self._system.withdrawn()

    @service
    def set_discovery(self, on: bool) -> None:
        """Look for containers of the system that broadcast, and link to each."""
        self._system.set_discovery(on)

    @service
    def set_broadcast(self, on: bool) -> None:
        """Answer those who look for containers of the system."""
        self._system.set_broadcast(on)

    @service
    def connect(self, endpoint: str) -> None:
        """Link to the container that listens there; CannotConnect if nobody there lets this one in."""
        self._system.connect(endpoint)

    @service
    def disconnect(self, endpoint: str) -> None:
        """Dial an endpoint no more; LinkStays if a link is there, which only the end of a container ends."""
        self._system.disconnect(endpoint)

    @service
    def load_policy(self, path: str) -> None:
        """Go by another access policy, or by its file as it is now; a wrong one leaves the old one running."""
        self._system.load_policy(path)
