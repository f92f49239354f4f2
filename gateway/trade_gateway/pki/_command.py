"""``trade pki``: issues, renews and revokes the certificates of containers and gateways."""

import shlex
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape

from trade_gateway._usage import UsageError
from trade_gateway.terminal import sections
from trade_gateway.terminal._options import CONNECTION, TIMING, Json
from trade_gateway.terminal._output import Output

if TYPE_CHECKING:
    from trade_gateway.pki._authority import Authority, Issued

SECTION: Final = sections.RIGHTS
PLACE: Final = 0
_PURPOSES: Final = ("container", "gateway")
_LONGEST_HOURS: Final = 366 * 24.0
_DEFAULT: Final = Path("pki")

app = typer.Typer(
    no_args_is_help=True,
    help="Issue, renew and revoke the certificates that prove identities.\n\n"
    "For example: trade pki issue arm --address 192.168.1.5",
)

Name = Annotated[str, typer.Argument(help="Identity: letters, digits, _ - and .")]
Folder = Annotated[Path, typer.Option("--ca", help="Folder of the authority.")]


@app.command()
def init(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the authority.")] = _DEFAULT) -> None:
    """Create a certificate authority.

    Its ca.key can issue any identity of the system.

    For example: trade pki init pki, and then trade pki issue arm
    """
    from trade_gateway.pki._authority import Authority  # noqa: PLC0415 - loads what the other commands do not need

    made = Authority.create(folder)
    Output(as_json=False).say(
        f"{escape(str(made.folder))} has an authority. Keep ca.key secret and off the robots, and keep a copy "
        "in a safe place.\n"
        f"Next: [bold]trade pki issue NAME --ca {escape(_quoted(folder))}[/]"
    )


@app.command()
def issue(
    name: Name,
    purpose: Annotated[
        str | None, typer.Option("--for", help="container or gateway. A name's purpose cannot be changed later.")
    ] = None,
    host: Annotated[
        list[str] | None, typer.Option(rich_help_panel=CONNECTION, help="Host name in the certificate. Repeatable.")
    ] = None,
    address: Annotated[
        list[str] | None, typer.Option(rich_help_panel=CONNECTION, help="IP address in the certificate. Repeatable.")
    ] = None,
    hours: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=_LONGEST_HOURS,
            rich_help_panel=TIMING,
            help="Validity in hours, by default a week. Links cannot be revoked before it ends, so keep it short.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Make a new key, and drop earlier hosts and addresses.")
    ] = False,
    folder: Folder = _DEFAULT,
    as_json: Json = False,
) -> None:
    """Issue or renew the certificate of a container or gateway.

    A renewed certificate has the same key and hosts, and replaces the old one in one step.
    A running container uses the new one for new connections, but listens with the old one until it is restarted.

    For example: trade pki issue arm --address 192.168.1.5
    """
    if purpose not in (None, *_PURPOSES):
        raise UsageError(where=f"--for {purpose}", problem=f"is no purpose; use {' or '.join(_PURPOSES)}")
    authority = _authority(folder)
    renewed = not force and any(one.name == name and one.until for one in authority.issued())
    given = authority.issue(
        name,
        purpose="gateway" if purpose == "gateway" else "container" if purpose else None,
        hosts=host or (),
        addresses=address or (),
        lasts=timedelta(hours=hours) if hours else None,
        new_key=force,
    )
    out = Output(as_json=as_json)
    if as_json:
        out.data(_plain(given))
        return
    advice = _to_renew if renewed else _for_gateway if given.purpose == "gateway" else _for_container
    out.say(escape("\n".join((f"{given.name}, a {given.purpose}, until {_moment(given.until)}", *advice(given)))))


def _to_renew(given: "Issued") -> list[str]:
    return [
        "Its key and ca.pem are unchanged, so copy only this file over the old one on its host:",
        f"  {given.folder / 'cert.pem'}",
        f"It accepts connections as {', '.join(given.hosts)}" if given.hosts else "It is reachable on its host only.",
    ]


def _for_gateway(given: "Issued") -> list[str]:
    endpoints = _endpoints(given)
    return [
        *_where(given),
        "Name the folder in its gateway file, and each address in the table of its network:",
        f'  tls = "{given.folder}"',
        *(f'  listen = ["{endpoint}"]' for endpoint in endpoints),
        *([] if endpoints else [f"  (it has no address yet: trade pki issue {given.name} --address ADDRESS)"]),
        f'  trade gateway GATEWAY.toml          # the policy it names needs gateways = ["{given.name}"]',
    ]


def _for_container(given: "Issued") -> list[str]:
    endpoints = ",".join(_endpoints(given))
    return [
        *_where(given),
        "Copy them to its host, and start it with them and the system's policy:",
        f"  export TRADE_SYSTEM=SYSTEM TRADE_TLS={_quoted(given.folder)} TRADE_POLICY=POLICY.toml",
        *([f"  export TRADE_LISTEN={endpoints}          # where it listens"] if endpoints else []),
        "  export TRADE_CONNECT=tls/ADDRESS:7450          # what it connects to: a gateway, or a robot"
        + (", if any" if endpoints else "; it is reachable on its host only"),
        "  trade services          # or trade up ROBOT.toml, or your own program",
    ]


def _where(given: "Issued") -> list[str]:
    return ["ca.pem, cert.pem and key.pem (secret) are in", f"  {given.folder}"]


def _endpoints(given: "Issued") -> list[str]:
    """Returns its listening endpoints; certificates do not support IPv6."""
    return [f"tls/{host}:7450" for host in given.hosts if ":" not in host]


@app.command()
def revoke(name: Name, folder: Folder = _DEFAULT) -> None:
    """Revoke an identity permanently.

    It is not issued again, and policies refuse it.

    For example: trade pki revoke arm
    """
    taken = _authority(folder).revoke(name)
    Output(as_json=False).say(
        f"{name} is revoked and not issued again. Links do not check revocation: its certificate can link until "
        f"{_moment(taken.until)}. Until then, only policies with this list refuse it:\n"
        f"  {escape(str(taken.folder.parents[1] / 'revoked.toml'))}\n"
        "Copy the list to the path of `revoked_file` in the policy of every host. Running containers read it within "
        "seconds, and log that."
    )


@app.command("list")
def list_(folder: Folder = _DEFAULT, as_json: Json = False) -> None:
    """List identities with purpose, expiry and state.

    For example: trade pki list --json
    """
    out = Output(as_json=as_json)
    found = _authority(folder).issued()
    if as_json:
        out.data([_plain(one) for one in found])
    elif not found:
        out.say("no identity was issued yet; [bold]trade pki issue NAME[/] issues one")
    else:
        rows = [(one.name, one.purpose, _moment(one.until), _state(one), ", ".join(one.hosts)) for one in found]
        out.table(("NAME", "FOR", "UNTIL", "STATE", "HOSTS"), rows)


def _authority(folder: Path) -> "Authority":
    from trade_gateway.pki._authority import Authority  # noqa: PLC0415 - loads what the other commands do not need

    return Authority(folder)


def _plain(given: "Issued") -> dict[str, Any]:
    return {
        "name": given.name,
        "for": given.purpose,
        "until": given.until,
        "hosts": given.hosts,
        "state": _state(given),
        "revoked": given.revoked,
        "folder": str(given.folder),
    }


def _state(given: "Issued") -> str:
    if given.revoked:
        return "revoked"
    if given.until is None:
        return "files gone"
    return "valid" if given.until > datetime.now(timezone.utc) else "expired"


def _moment(when: datetime | None) -> str:
    return f"{when:%Y-%m-%d %H:%M} UTC" if when else "an unknown time"


def _quoted(folder: Path) -> str:
    return shlex.quote(str(folder))
