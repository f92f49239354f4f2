"""``trade gateway GATEWAY.toml``: joins networks, and forwards calls that the file and its policy allow."""

import queue
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.markup import escape

from trade import Container, Settings
from trade.errors import ConfigurationError, TradeError
from trade.policies import EVERYTHING
from trade_gateway.cli.robots._child_news import say_news
from trade_gateway.cli.robots._file_changes import FileDigests, digest, named_by
from trade_gateway.cli.robots._hub import allow_many_links
from trade_gateway.config._gateway_file import Plan, read_gateway_file
from trade_gateway.process._addresses import forwarding
from trade_gateway.process._signals import hangups, leaving, settle
from trade_gateway.sharing._guests import SystemGuests, opened
from trade_gateway.supervisor import ChildServices, News, Supervisor
from trade_gateway.supervisor._described import described
from trade_gateway.terminal._detached import Detach, detach_now, ready
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._sd_notify import Notifier

_LOOK_EVERY_S: Final = 1.0


def gateway(
    file: Annotated[Path, typer.Argument(metavar="GATEWAY.toml", help="The gateway file.")],
    check: Annotated[bool, typer.Option("--check", help="Check the file and exit.")] = False,
    detach: Detach = False,
    as_json: Json = False,
) -> None:
    """Forward calls between networks, as the file and its policy allow.

    A gateway can also share groups with other systems.
    It supervises the containers of its host that the file names: it restarts them when they crash or hang.

    It reads the file again when the file, its policy, its revoked names or its certificate change, and on SIGHUP.
    If the new file has an error, the gateway reports it and continues as before.

    For example: trade gateway /etc/trade/gateway.toml --check
    """
    out, notifier = Output(as_json=as_json), Notifier()
    plan = read_gateway_file(file)
    plan.check_here(file)
    unnamed = plan.unnamed  # read once: later the policy may be half written
    _warn_of_forwarding(plan)
    if check:
        if unnamed:
            raise ConfigurationError(where=str(plan.settings.policy), problem=unnamed)
        out.say(f"{file} is right")
        _say_what_crosses(out, plan)
        _say_children(out, plan)
        return
    if detach:
        detach_now(out, plan.settings)
        return
    if plan.file.hub:
        allow_many_links()
    with leaving() as asked_to_leave, hangups() as hangup, notifier:
        seen = digest(file)
        running = Gateway(file, plan, named_by(file, plan), asked_to_leave.set)
        try:
            settle()
            _say_ready(out, running, plan)
            if unnamed:
                complain(f"{plan.settings.policy}: {unnamed}")
            notifier.ready(_status(running))
            while not asked_to_leave.wait(_LOOK_EVERY_S):
                if running.healthy:
                    notifier.alive()
                say_news(out, running.news)
                now = digest(file)
                if now != seen or hangup.is_set():
                    seen, reopen = now, hangup.is_set()
                    hangup.clear()
                    notifier.reloading()
                    good = running.reload(file, out, reopen=reopen)
                    notifier.ready(_status(running) if good else f"{file} has an error; continuing as before")
        finally:
            notifier.leaving()
            out.say("leaving")
            running.close()
            say_news(out, running.news)


class Gateway:
    """The gateway's container, its guests in other systems and its children, as the file says now."""

    def __init__(self, file: Path, plan: Plan, named: FileDigests, leave: Callable[[], None]) -> None:
        self._file = file
        self._plan = plan
        self._leave = leave
        """Ends the gateway when its container is terminated."""
        self._named = named
        """The contents of the files that the gateway file names."""
        self._guests = SystemGuests()
        self._container = Container(plan.settings, on_terminate=leave)
        self._running: Settings | None = plan.settings
        """The settings of the open container."""
        self._supervisor: Supervisor | None = None
        self.news: queue.SimpleQueue[News] = queue.SimpleQueue()
        """Reports about the children."""
        try:
            self._guests.apply(self._container, plan)
            self._look_after(plan)
        except BaseException:
            self.close()
            raise

    @property
    def container(self) -> Container:
        """The container that runs now."""
        return self._container

    @property
    def healthy(self) -> bool:
        """Whether it can serve a call now, and its children are supervised."""
        return self._container.healthy() and (self._supervisor is None or self._supervisor.alive)

    def reload(self, file: Path, out: Output, *, reopen: bool = True) -> bool:
        """Applies the file as it is now; returns False, with nothing changed, if that fails.

        Args:
            file: the gateway file.
            out: where to report it.
            reopen: open all connections again, even if the file is unchanged.
        """
        try:
            plan = read_gateway_file(file)
            plan.check_here(file)
            named = named_by(file, plan)
        except TradeError as wrong:
            complain(f"{file} was changed and has an error; continuing as before: {wrong}")
            return False
        changed = named.since(self._named)
        reopen = reopen or named.digests != self._named.digests
        try:
            self._set_plan(plan, reopen=reopen)
        except TradeError as refused:
            self._set_plan(self._plan, reopen=False)
            complain(f"{file} was changed and cannot be used; continuing as before: {refused}")
            return False
        self._plan, self._named = plan, named
        self._container.note_change("gateway file read", f"{file}: {changed}" if changed else str(file))
        self._look_after(plan)
        out.say(escape(f"read {file} again{': ' if changed else ''}{changed}"))
        if out.as_json:
            out.data({"reloaded": str(file), "changed": changed})
        return True

    def _set_plan(self, plan: Plan, *, reopen: bool) -> None:
        if reopen or plan.settings != self._running:
            self._running = None
            self._leave_networks()
            self._container = opened(plan.settings, self._leave)
            self._offer()
            self._running = plan.settings
        self._guests.apply(self._container, plan)

    def _look_after(self, plan: Plan) -> None:
        """Supervises the children that the file names; unchanged ones keep running."""
        if self._supervisor is None and plan.children:
            state = plan.settings.state_dir or Path(tempfile.gettempdir())
            self._supervisor = Supervisor(lambda: self._container, self.news.put, state / plan.settings.system)
            self._offer()
        if self._supervisor is not None:
            self._supervisor.set_children(plan.children)

    def _offer(self) -> None:
        if self._supervisor is not None:
            services = ChildServices(self._supervisor, lambda: described(self._file, self._plan))
            self._container.register_functions(services, "supervisor")

    def _leave_networks(self) -> None:
        self._guests.close()
        self._container.close()

    def close(self) -> None:
        """Ends the children, then leaves all networks and systems. Idempotent."""
        if self._supervisor is not None:
            self._supervisor.close()
        self._leave_networks()


def _warn_of_forwarding(plan: Plan) -> None:
    """Warns if the host's kernel forwards packets between the gateway's networks."""
    interfaces = [network.interface for network in plan.file.network.values()]
    if len(plan.file.network) + len(plan.file.share) > 1 and (on := forwarding(interfaces)):
        complain(
            f"this host forwards packets between its networks ({', '.join(on)}), so a host with a route through it can "
            "connect to containers past the gateway, and `export` does not apply; run sudo sysctl -w "
            "net.ipv4.ip_forward=0 net.ipv6.conf.all.forwarding=0, or let a firewall drop forwarded packets"
        )


def _status(running: Gateway) -> str:
    settings = running.container.settings
    return f"{settings.container} is up in system {settings.system}, as {settings.identity}"


def _say_ready(out: Output, running: Gateway, plan: Plan) -> None:
    settings = plan.settings
    if out.as_json:
        networks = {name: None if settings.exports is None else settings.exports[name] for name in settings.bridge}
        out.data(
            {
                **ready(running.container),
                "identity": settings.identity,
                "listen": settings.listen,
                "networks": networks,
                "shares": {name: _share(plan, name) for name in plan.shares},
                "children": [child.name for child in plan.children],
            }
        )
        return
    out.say(f"[bold green]{running.container.name} is up[/] in system {settings.system}, as {settings.identity}")
    _say_what_crosses(out, plan)
    _say_children(out, plan)
    out.say("Ctrl-C leaves; the file is read again when it changes")


def _share(plan: Plan, name: str) -> dict[str, object]:
    share, settings = plan.file.share[name], plan.shares[name]
    return {
        "system": settings.system,
        "identity": settings.identity,
        "listen": settings.listen,
        "export": share.export,
        "import": share.import_,
    }


def _say_what_crosses(out: Output, plan: Plan) -> None:
    settings = plan.settings
    for name in settings.bridge:
        groups = (EVERYTHING,) if settings.exports is None else settings.exports[name]
        out.say(f"  {name}: others see {_listed(groups)} of it")
        for group, hz in settings.stream_hz.get(name, {}).items():
            out.say(f"    and at most {hz:g} samples a second of each stream of {_listed([group])}")
    for name, share in plan.file.share.items():
        guest = plan.shares[name]
        out.say(f"  system {guest.system}, as {guest.identity}: it sees {_listed(share.export)} of {settings.system}")
        out.say(f"  and {settings.system} sees {_listed(share.import_)} of {guest.system}")


def _say_children(out: Output, plan: Plan) -> None:
    for child in plan.children:
        out.say(f"  it keeps {escape(child.name)} up: {child.part.entry.kind}")


def _listed(groups: Sequence[str]) -> str:
    return ", ".join(groups).replace(EVERYTHING, "everything") or "nothing"
