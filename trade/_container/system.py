"""The controls of a container; ``trade.system`` has those of the default one."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from trade._calls.handle import Handle
from trade._container.assembly import Components
from trade._migration.delivered_code import pack
from trade._registry.constraints import where
from trade._remote.ssh import Started, start
from trade._services.withdrawn import WithdrawnInfo
from trade._table import Table
from trade._telemetry.load import LoadInfo
from trade.errors import ConfigurationError, LinkStays, NoSuchService, TooManyServices
from trade.protocol.container_info import ContainerInfo
from trade.protocol.keys import CLOCK, DOMAIN, PROVIDER, ServiceKey


class System:
    """The controls of a running container: its links, its discovery, its providers and its end.

    None of them disturbs calls under way. Each is also a service in group ``trade`` of every container.
    """

    def __init__(self, components: Callable[[], Components]) -> None:
        self._components = components

    def set_discovery(self, on: bool) -> None:
        """Switches discovery: links to all containers of this system that broadcast; existing links stay.

        It searches where the container listens: on this host, or on its networks.
        """
        parts = self._components()
        was = parts.reach.discovers
        parts.reach.set_discovery(on)
        self._note_switched("discovery", was=was, on=on)

    def set_broadcast(self, on: bool) -> None:
        """Switches broadcasting: answers the discovery of other containers of this system."""
        parts = self._components()
        was = parts.reach.broadcasts
        parts.reach.set_broadcast(on)
        self._note_switched("broadcast", was=was, on=on)

    def _note_switched(self, what: Literal["discovery", "broadcast"], *, was: bool, on: bool) -> None:
        if was is not on:
            parts = self._components()
            clock = parts.client.handle(ServiceKey(parts.client.address, DOMAIN, PROVIDER, CLOCK)).record
            parts.events.note(what, parts.client.address.container, "on" if on else "off", clock)

    def connect(self, endpoint: str) -> None:
        """Links to the container at an endpoint, and again whenever the link is lost.

        Args:
            endpoint: such as ``tcp/127.0.0.1:7450`` or ``tcp/robot.example:7450``; names are resolved at every attempt.

        Raises:
            CannotConnect: no container there accepts this one.
            ConfigurationError: no endpoint, or a network, with neither system id nor credentials (S21).
        """
        self._components().reach.connect(endpoint)

    def disconnect(self, endpoint: str) -> None:
        """Stops dialling an endpoint.

        Args:
            endpoint: the endpoint that `connect` got, or the name of a container.

        Raises:
            LinkStays: the link stays until one of its containers closes, but is not dialled again.
        """
        if any(info.name == endpoint for info in self.containers()):
            raise LinkStays(to=endpoint)
        self._components().reach.disconnect(endpoint)

    def containers(self) -> Table[ContainerInfo]:
        """The containers of the system, this one included."""
        components = self._components()
        components.client.check_open()
        return components.containers()

    def load(self) -> LoadInfo:
        """The load of this container, its process and its host."""
        return self._components().load_meter.read()

    def deregister(self, service: Handle) -> str:
        """Withdraws the provider of a service of this container, which keeps the object to register it again.

        Returns:
            The name to `register` it with. Handles of its services fail from now on.

        Raises:
            ConfigurationError: it is not registered here, or is the middleware's own.
        """
        parts = self._components()
        home = service.key.address
        if home != parts.client.address:
            problem = f"it belongs to another container, or to an earlier epoch; call deregister of {home.container}"
            raise ConfigurationError(where=service.label, problem=problem)
        return parts.withdrawn_providers.take_off(service.key)

    def register(self, provider: str, groups: tuple[str, ...] | None = None) -> tuple[Handle, ...]:
        """Offers an object again that was deregistered through this container.

        Args:
            provider: the name that `deregister` returned.
            groups: new groups, in place of the earlier ones.

        Returns:
            Handles of its services; earlier handles stay stale.

        Raises:
            ConfigurationError: no such provider was deregistered, or a malformed group.
        """
        parts = self._components()
        return tuple(map(parts.client.handle, parts.withdrawn_providers.put_back(provider, groups)))

    def withdrawn(self) -> list[WithdrawnInfo]:
        """The providers that `register` can offer again, by name."""
        return self._components().withdrawn_providers.infos()

    def instantiate(
        self,
        class_path: str,
        args: Sequence[Any] | Mapping[str, Any] = (),
        groups: str | Sequence[str] = (),
        state: Any = None,
    ) -> tuple[Handle, ...]:
        """Creates an object of a class and offers its services.

        Args:
            class_path: such as ``mypkg.vision:Camera``; the container's ``instantiable`` must allow it.
            args: for its constructor, in order or by name; plain data.
            groups: as for `register`.
            state: the result of another object's ``save_state()``; the new object takes it before any client can call
                it, and moves nothing (S18). None: it starts without state.

        Returns:
            Handles of its services.

        Raises:
            NotInstantiable: the container's settings do not allow it; nothing was imported.
            NoSuchClass: the container has no such class.
            CannotInstantiate: its module or its constructor raised, or it does not take the state.
            ConfigurationError: it has no services, or a group is malformed; the object is closed again.
        """
        parts = self._components()
        factory, named = parts.factory, (groups,) if isinstance(groups, str) else tuple(groups)
        if state is not None:
            keys = parts.migration_target.recreate(class_path, args, named, state)
            return tuple(map(parts.client.handle, keys))
        return factory.offer(factory.make(factory.find(class_path), args), named, args)

    def add_code(self, archive: bytes) -> str:
        """Keeps an archive of modules in this container, which imports from it now and after a restart.

        What is installed comes first, so an archive replaces nothing. Code that was imported stays as it is: a new
        version needs a new container.

        Args:
            archive: the bytes of a wheel or a zip file without compiled modules, at most 32 MiB.

        Returns:
            Its SHA-256.

        Raises:
            CodeRefused: ``Settings.code`` does not list the hash, or it cannot be kept; nothing was imported.
        """
        return self._components().factory.code.add(archive)

    def send_code(self, container: str, path: Path, *, deadline_s: float = 60.0) -> str:
        """Brings a wheel or a folder of modules to another container, which must list its hash: `trade code PATH`.

        Args:
            container: the name of the container.
            path: a wheel, a zip file or a folder.
            deadline_s: how long it may take, in seconds.

        Returns:
            The SHA-256 of the archive.

        Raises:
            CodeRefused: the container does not take it.
            ConfigurationError: it cannot be read, has no modules, has compiled ones, or is too large.
        """
        archive = pack(path)
        taking = self._components().client.find(where(name="add_code", group=DOMAIN, container=container))
        sha256: str = taking.with_(deadline_s=deadline_s)(archive)
        return sha256

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
        """Starts an empty container of this system on another host, and waits until it is visible here.

        It uses the ``ssh`` program with this user's keys and configuration, without prompts, and connects only to hosts
        with a known key. What the container needs to join the system (certificate, policy, credentials) must exist on
        the host, or is given in ``environment``, which others on either host may see.

        Args:
            host: ``HOST`` or ``USER@HOST``, as for ssh.
            name: the container's name.
            allow: classes that may be created in it.
            connect: endpoints that it dials, as seen from there; none: those of its environment.
            command: the ``trade`` command there; a path, or several words.
            environment: variables for it.
            ssh_config: a file to use instead of the user's own.
            wait_s: how long it may take to become visible after its start; then it is ended again.

        Raises:
            CannotStart: with the reason, and what to do.
            ConfigurationError: the host or a variable is not valid.
        """
        parts = self._components()

        def joined(started: Started) -> ContainerInfo | None:
            with contextlib.suppress(NoSuchService, TooManyServices):  # the epoch identifies it
                parts.client.find(where(name=CLOCK, group=DOMAIN, container=name), wait_s=wait_s)
            return next((info for info in self.containers() if info.epoch == started.epoch), None)

        return start(
            host,
            name,
            system=parts.settings.system,
            joined=joined,
            wait_s=wait_s,
            allow=allow,
            connect=connect,
            command=command,
            environment=environment,
            ssh_config=ssh_config,
        )

    def terminate(self, service: Handle) -> None:
        """Ends a provider that `instantiate` created in this container: its motion stops, then it is closed.

        ``close()`` of the object is called, if it has one.

        Raises:
            ConfigurationError: this container did not create it, or it has ended.
            DeviceFault: it could not be stopped; it is offered as before.
        """
        self._components().factory.terminate(service)

    def terminate_container(
        self, reason: str = "", *, only_at_rest: bool = False, identity: str = "itself"
    ) -> list[str]:
        """Ends this container: its motion stops, and its services are withdrawn. Does not wait for its end.

        The process continues, unless it is one of ``trade container``, ``trade up`` or ``trade gateway``.

        Args:
            reason: why, for people; it is logged.
            only_at_rest: not while one of its resources is locked or moves.
            identity: the requesting client; it is logged.

        Returns:
            The stops that failed, with their reasons; the container ends nevertheless.

        Raises:
            InUse: a resource is locked or moves, with ``only_at_rest``.
        """
        return self._components().shutdown.begin(reason, identity, only_at_rest=only_at_rest)

    def load_policy(self, path: str) -> None:
        """Loads another access policy, or the same file again; calls under way continue.

        Args:
            path: of the policy, as this container's host sees it.

        Raises:
            ConfigurationError: the policy is wrong; the message says where. The earlier policy stays in force.
        """
        self._components().load_policy(path)
