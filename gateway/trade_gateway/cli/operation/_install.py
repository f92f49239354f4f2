"""``trade install GATEWAY.toml``: writes a systemd unit for a gateway, and udev rules for serial adapters."""

import hashlib
import os
import pwd
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

import typer
from msgspec import structs
from rich.markup import escape

from trade.atomic_files import replace
from trade.errors import ConfigurationError
from trade_drivers import load
from trade_gateway._usage import UsageError
from trade_gateway.cli.operation._file_closure import NamedFiles, named_files
from trade_gateway.cli.operation._systemd_unit import UDEV_RULES, hidden_in, needs_of, program_folders, unit_text
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.terminal._output import Output

_MARK: Final = re.compile(r"# Written by `trade install`; [^\n]* sha256 ([0-9a-f]{64})\n")
_HEAD: Final = "# Written by `trade install`; what you change here it will not overwrite. sha256 {digest}\n{text}"
_UNITS: Final = "etc/systemd/system"
_RULES: Final = "etc/udev/rules.d/60-trade.rules"
_NAME: Final = re.compile(r"[A-Za-z0-9_][\w.-]*")
_USER: Final = re.compile(r"[a-z_][a-z0-9_-]{0,30}")


def install(
    file: Annotated[Path, typer.Argument(metavar="GATEWAY.toml", help="The gateway file.")],
    user: Annotated[str, typer.Option(help="User that the service runs as.")] = "trade",
    name: Annotated[str, typer.Option(help="Name of the service.")] = "trade-gateway",
    root: Annotated[Path, typer.Option(help="Root folder of the target computer.")] = Path("/"),
    show: Annotated[bool, typer.Option("--print", help="Print the files and exit.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Also overwrite files with other changes.")] = False,
) -> None:
    """Write a systemd unit for a gateway, and udev rules for serial adapters.

    This starts nothing. The unit gives the gateway only the rights that its file and robot files need.
    Put your own changes into NAME.service.d/*.conf. Run this again after a change of the gateway or robot files.

    For example: sudo trade install /etc/trade/gateway.toml
    For another computer: trade install image/etc/trade/gateway.toml --root image
    """
    for given, form, option in ((name, _NAME, "--name"), (user, _USER, "--user")):
        if not form.fullmatch(given):
            raise UsageError(where=f"{option} {given}", problem="is no valid name; use letters, digits, _ and -")
    _require_there(file, root)
    plan = read_gateway_file(file)
    if root == Path("/"):
        plan.check_here(file)
    named = named_files(file)
    bodies = {root / _UNITS / f"{name}.service": _unit(named, user, root), root / _RULES: UDEV_RULES}
    texts = {path: _marked(body) for path, body in bodies.items()}
    if show:
        for path, text in texts.items():
            print(f"# {path}\n{text}")  # noqa: T201 - unchanged, for other programs
        return
    out = Output(as_json=False)
    fresh = [path for path, text in texts.items() if _is_to_be_written(path, text, force=force)]
    for path, text in texts.items():
        if path in fresh:
            _write(path, text)
        out.say(escape(f"{'wrote' if path in fresh else 'is up to date:'} {path}"))
    for doubt in _doubts(named, user, root):
        out.say(f"[yellow]warning[/]  {escape(doubt)}")
    _say_next(out, user, name, named.records)


def _require_there(file: Path, root: Path) -> None:
    """Raises UsageError if the file is named as the target computer sees it."""
    there = root / str(file).lstrip("/")
    if not file.exists() and there.exists():
        raise UsageError(where=str(file), problem=f"does not exist on this computer; did you mean {there}?")


def _doubts(named: NamedFiles, user: str, root: Path) -> Iterable[str]:
    """Returns warnings about files that the service may not find, or not permanently."""
    for what, path in (("the Python", Path(sys.executable)), *(("file", one) for one in named.files)):
        seen = _seen(path, root)
        if (hidden := hidden_in(seen)) is not None:
            why = f"user {user} may have no access, and temporary files are removed; use /opt and /etc instead"
            yield f"{what} {seen} lies in {hidden}: {why}"
        elif checkout := next((one for one in path.parents if (one / ".git").exists()), None):
            yield f"{what} {seen} lies in the checkout {checkout}: a change there changes the service"
    yield from _closed_to(user, named.files) if root == Path("/") else ()
    for port in needs_of(map(load, named.robots)).devices:
        if (hidden := hidden_in(Path(port))) is not None:
            yield f"port {port} lies in {hidden}, which the service does not see: is it a simulated one?"


def _closed_to(user: str, files: Sequence[Path]) -> Iterable[str]:
    """Returns each file or folder at the gateway file that the service's user cannot read or enter."""
    try:
        known = pwd.getpwnam(user)
    except KeyError:  # not created yet, which the next steps say
        return
    groups, own = os.getgrouplist(user, known.pw_gid), files[0].parent
    beside = (path for file in files for path in (*reversed(file.parents), file) if path.is_relative_to(own))
    for path in dict.fromkeys(beside):
        with suppress(OSError):
            if not _may(path.stat(), known.pw_uid, groups, is_folder=path.is_dir()):
                action, mode = ("enter", "0750") if path.is_dir() else ("read", "0640")
                named = shlex.quote(str(path))
                remedy = f"sudo chgrp {known.pw_gid} {named} && sudo chmod {mode} {named}"
                yield f"user {user} cannot {action} {path}, so the service will not start: {remedy}"


def _may(path: os.stat_result, uid: int, groups: Sequence[int], *, is_folder: bool) -> bool:
    """Whether a user may enter a folder, or read a file."""
    shift = 6 if path.st_uid == uid else 3 if path.st_gid in groups else 0
    return bool(path.st_mode >> shift & (0o1 if is_folder else 0o4))


def _seen(path: Path, root: Path) -> Path:
    """Returns a path as the computer with that root folder sees it."""
    above = Path(os.path.normpath(root.absolute()))
    return Path("/") / path.relative_to(above) if path.is_relative_to(above) else path


def _unit(named: NamedFiles, user: str, root: Path) -> str:
    def seen(path: Path) -> Path:
        return _seen(path, root)

    return unit_text(
        seen(named.files[0]),
        user=user,
        needs=structs.replace(needs_of(map(load, named.robots)), hub=named.hub),
        containers=named.containers,
        program=[str(seen(Path(sys.executable))), "-m", "trade_gateway"],
        folders=map(seen, (*program_folders(), *(one.parent for one in named.files))),
        records=map(seen, named.records),
    )


def _marked(text: str) -> str:
    return _HEAD.format(digest=hashlib.sha256(text.encode()).hexdigest(), text=text)


def _is_to_be_written(path: Path, text: str, *, force: bool) -> bool:
    """Whether a file is to be written. Raises ConfigurationError if it has changes of others."""
    try:
        found = path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        return True
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
    mark = _MARK.match(found)
    unchanged = mark is not None and _marked(found[mark.end() :]) == found
    if found != text and not unchanged and not force:
        problem = "was changed since" if mark else "was not written by `trade install`"
        remedy = "move it away, or put your changes into a .d folder beside it and use --force. Nothing was written"
        raise ConfigurationError(where=str(path), problem=f"{problem}; {remedy}")
    return found != text


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace(path, text.encode(), 0o644)
    except PermissionError:
        again = shlex.join([sys.executable, "-m", "trade_gateway", *sys.argv[1:]])
        raise ConfigurationError(where=str(path), problem=f"needs the rights of root: sudo {again}") from None
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be written: {bad.strerror}") from None


def _say_next(out: Output, user: str, name: str, records: Iterable[Path]) -> None:
    out.say("Next, on that computer:")
    try:
        pwd.getpwnam(user)
    except KeyError:
        out.say(f"  sudo useradd --system --user-group --home-dir /var/lib/trade --shell /usr/sbin/nologin {user}")
    for folder in records:
        out.say(escape(f"  sudo install --directory --owner {user} --mode 0700 {shlex.quote(str(folder))}"))
    out.say("  sudo udevadm control --reload")
    out.say("  sudo udevadm trigger --action=add --subsystem-match=tty --subsystem-match=usb-serial")
    out.say("  sudo systemctl daemon-reload")
    out.say(f"  sudo systemctl enable {name} && sudo systemctl restart {name}")
