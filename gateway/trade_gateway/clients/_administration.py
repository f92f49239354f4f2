"""Changes of the system by clients: each is checked by the client's rights, and is then a call of the middleware's
own service, which checks the rights of the HTTP gateway."""

from collections.abc import Callable
from typing import Any, Final

import msgspec

from trade import Container, Handle, where
from trade.errors import AccessDenied, NoSuchService, TooManyServices, TradeError
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._changes import (
    ContainerState,
    Done,
    InstantiateBody,
    MigrateBody,
    ProviderBody,
    ReasonBody,
)
from trade_gateway.clients._system_info import Counted

_OWN: Final = "trade"
_DEADLINE_S: Final = 12.0
"""For a change, in seconds; a migration has its own."""


class Administration:
    """Shows the system's containers to clients, and changes them in their names.

    Args:
        container: the gateway's container.
        judge: authorises its clients.
        counted: runs a function with its arguments for an identity.
    """

    def __init__(self, container: Container, judge: ClientAuthorizer, counted: Counted) -> None:
        self._container = container
        self._judge = judge
        self._counted = counted

    # --- what there is

    async def system(self, identity: str) -> list[ContainerState]:
        """Returns the containers, and the supervised ones without a process. Raises AccessDenied.

        Links, switches and supervision are shown to clients that may read the system.
        """
        self._judge.require_some(identity, "system")
        return await self._counted(identity, self._system, identity)

    def _system(self, identity: str) -> list[ContainerState]:
        reads = self._judge.may_system(identity, "read")
        children = self._by_container("children") if reads else {}
        network = self._by_container("network") if reads else {}
        by_child = {child["name"]: (gateway, child) for gateway, found in children.items() for child in found}
        found: list[ContainerState] = []
        hosts = {info.name: info.host for info in self._container.containers()}
        for info in self._container.containers():
            gateway, child = by_child.pop(info.name, ("", {}))
            there = [one for one in self._container.services() if one.container == info.name]
            offered = [one for one in there if one.key.domain != _OWN]
            reported = network.get(info.name, {})
            found.append(
                ContainerState(
                    name=info.name,
                    identity=info.identity,
                    host=info.host,
                    own=info.epoch == self._container.address.epoch,
                    services=len(offered),
                    actuating=sum(one.effect == "actuate" for one in offered),
                    groups=tuple(sorted({one.key.domain for one in offered if self._judge.sees(identity, one)})),
                    links=_others(reported.get("links")),
                    discovery=reported.get("discovery"),
                    broadcast=reported.get("broadcast"),
                    supervised_by=gateway,
                    supervises=tuple(child["name"] for child in children.get(info.name, ())),
                    **_supervision(child),
                )
            )
        others = (
            ContainerState(
                name=name,
                host=hosts.get(gateway, "") if child["pid"] else "",
                supervised_by=gateway,
                **_supervision(child),
            )
            for name, (gateway, child) in by_child.items()
        )
        return sorted([*found, *others], key=lambda one: one.name)

    def _by_container(self, name: str) -> dict[str, Any]:
        """Calls one of the middleware's services that only some containers have; plain results by container."""
        outcomes = self._container.call_all(where(name=name, group=_OWN))
        return {one.handle.container: msgspec.to_builtins(one.result, enc_hook=str) for one in outcomes if one.ok}

    # --- containers

    async def restart(self, identity: str, name: str, body: ReasonBody) -> Done:
        """Starts a supervised container, or starts it again. Raises AccessDenied, NoSuchService: none supervises it."""
        self._judge.require_system(identity, "administer", f"container {name}")

        def restart() -> Done:
            by = self._supervisor(name)
            if by is None:
                raise NoSuchService(constraint=f"a gateway that supervises a container {name!r}", groups=[])
            self.own("restart_child", by)(name)
            return Done(f"{by} starts {name} again.")

        return await self.noted(identity, "restart", name, restart, body.reason)

    async def end(self, identity: str, name: str, body: ReasonBody) -> Done:
        """Ends a container; a supervised one then stays ended. Raises AccessDenied, NoSuchService: there is none."""
        self._judge.require_system(identity, "administer", f"container {name}")

        def end() -> Done:
            by = self._supervisor(name)
            if by is not None:
                self.own("stop_child", by)(name)
                return Done(f"{by} ends {name}.")
            reason = f"{identity}: {body.reason}" if body.reason else f"by {identity}"
            failed: list[str] = self.own("terminate_container", name)(reason)
            return Done("; ".join([f"{name} ends.", *failed]))

        return await self.noted(identity, "end", name, end, body.reason)

    def _supervisor(self, name: str) -> str | None:
        """The gateway that supervises a container of a name."""
        children = self._by_container("children").items()
        return next((by for by, found in children if name in {child["name"] for child in found}), None)

    async def switch(self, identity: str, name: str, setting: str, *, on: bool) -> Done:
        """Switches ``discovery`` or ``broadcast`` of a container. Raises AccessDenied, NoSuchService."""
        self._judge.require_system(identity, "administer", f"container {name}")

        def switch() -> Done:
            self.own(f"set_{setting}", name)(on)
            return Done(f"{setting.capitalize()} is {'on' if on else 'off'} in {name}.")

        return await self.noted(identity, f"{setting} {'on' if on else 'off'}", name, switch)

    # --- providers

    async def migrate(self, identity: str, body: MigrateBody) -> Done:
        """Moves a provider. Raises AccessDenied, NoSuchService, TooManyServices; and like `trade.Container.migrate`."""
        service = self._one(identity, body.group, body.name, body.container)
        self._judge.require_groups(identity, "administer", service)

        def migrate() -> Done:
            moved = self._container.migrate(service, to=body.to)
            return Done(f"{body.group} is in {', '.join(sorted({one.container for one in moved}))} now.")

        return await self.noted(identity, "migrate", f"{service.label} to {body.to}", migrate)

    async def instantiate(self, identity: str, body: InstantiateBody) -> Done:
        """Creates a provider in a container, which must allow its class. Raises AccessDenied, NotInstantiable."""
        self._judge.require_system(identity, "administer", f"{body.class_path} in {body.container}")

        def instantiate() -> Done:
            made = self.own("instantiate", body.container)(body.class_path, body.args, tuple(body.groups))
            return Done(f"{body.container} offers {', '.join(one.label for one in made)}.")

        return await self.noted(identity, "instantiate", f"{body.class_path} in {body.container}", instantiate)

    async def terminate(self, identity: str, body: ProviderBody) -> Done:
        """Ends a provider that `instantiate` created. Raises AccessDenied, NoSuchService, TooManyServices."""
        self._judge.require_system(identity, "administer", body.group)
        service = self._one(identity, body.group, body.name, body.container)

        def terminate() -> Done:
            self.own("terminate", service.container)(service)
            return Done(f"{body.group} ended in {service.container}.")

        return await self.noted(identity, "terminate", service.label, terminate)

    # --- notifications and hooks

    async def cancel_notification(self, identity: str, name: str) -> Done:
        """Ends a notification of any client. Raises AccessDenied, NoSuchNotification."""
        self._judge.require_system(identity, "administer", f"notification {name}")
        cancel = self._container.cancel_notification
        return await self.noted(
            identity, "cancel_notification", name, lambda: _done(cancel(name), f"Notification {name} ended.")
        )

    async def detach_hook(self, identity: str, name: str) -> Done:
        """Detaches a hook of any client. Raises AccessDenied, NoSuchHook."""
        self._judge.require_system(identity, "administer", f"hook {name}")
        detach = self._container.detach_hook
        return await self.noted(identity, "detach_hook", name, lambda: _done(detach(name), f"Hook {name} is detached."))

    # --- parts

    async def noted(self, identity: str, action: str, subject: str, do: Callable[[], Done], reason: str = "") -> Done:
        """Makes a change, and audits it in its client's name."""

        def noted() -> Done:
            try:
                done = do()
            except TradeError as error:
                if not isinstance(error, AccessDenied):  # which the protocol audits
                    message = str(error)
                    self._container.note_request(
                        action, subject, client=identity, outcome=type(error).__name__, error=message
                    )
                raise
            self._container.note_request(action, subject, client=identity, error=reason)
            return done

        return await self._counted(identity, noted)

    def own(self, name: str, container: str) -> Callable[..., Any]:
        """One of the middleware's services of a container. Raises NoSuchService."""
        found = [one for one in self._container.services(where(name=name, group=_OWN)) if one.container == container]
        if not found:
            raise NoSuchService(constraint=f"container {container}", groups=[])
        return found[0].with_(deadline_s=_DEADLINE_S)

    def _one(self, identity: str, group: str, name: str, container: str) -> Handle:
        """A service of the only provider of a group. Raises NoSuchService, TooManyServices."""
        seen = [one for one in self._container.services() if self._judge.sees(identity, one)]
        inside = [one for one in seen if any(f"{each}.".startswith(f"{group}.") for each in one.groups)]
        found = [one for one in inside if name in ("", one.name) and container in ("", one.container)]
        if not found:
            raise NoSuchService(constraint=group, groups=sorted({each for one in seen for each in one.groups}))
        if len({_provider(one) for one in found}) > 1:
            matches = [f"{one.label} in {one.container}" for one in found]
            raise TooManyServices(constraint=group, matches=matches, differ=("group", "name", "container"))
        return found[0]


def _provider(service: Handle) -> tuple[Any, str, str]:
    return service.key.address, service.key.domain, service.key.provider


def _others(links: list[dict[str, Any]] | None) -> tuple[str, ...] | None:
    return None if links is None else tuple(sorted({link["to"] for link in links if link["to"]}))


def _supervision(child: dict[str, Any]) -> dict[str, Any]:
    return {name: child[name] for name in ("state", "restarts", "why") if child}


def _done(_nothing: None, text: str) -> Done:
    return Done(text)
