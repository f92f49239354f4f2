"""The reference of the command line: a page made of what `trade --help` and each command's `--help` say."""

import re
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, Final

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from trade_gateway.cli import build

PAGE: Final = "reference/commands.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page."""
    files.append(File.generated(config, PAGE, content="\n".join(_page())))
    return files


def _page() -> Iterator[str]:
    trade: Any = typer.main.get_command(build())
    yield "# The command trade\n"
    yield "Each command has `--help`. `--system` and `--connect` may stand before any of them.\n"
    yield from _options(trade)
    rooms: dict[str, list[Any]] = defaultdict(list)
    for command in trade.commands.values():
        rooms[command.rich_help_panel].append(command)
    for room, commands in rooms.items():
        yield f"\n## {room}\n"
        for command in commands:
            yield from _command(command, "trade")


def _command(command: Any, before: str) -> Iterator[str]:
    name = f"{before} {command.name}"
    yield f"\n### {name}\n"
    yield f"{_plain(command.help)}\n"
    if hasattr(command, "commands"):
        for each in command.commands.values():
            yield from _command(each, name)
        return
    usage = command.get_usage(typer.Context(command, info_name=name)).removeprefix("Usage: ")
    yield f"```text\n{' '.join(usage.split())}\n```\n"
    yield from _options(command)


def _options(command: Any) -> Iterator[str]:
    rows = [one for one in command.params if not getattr(one, "hidden", False) and getattr(one, "help", None)]
    if rows:
        yield "| | |\n|---|---|"
    for one in rows:
        positional = one.param_type_name == "argument"
        names = [one.metavar or one.name.upper()] if positional else [*one.opts, *one.secondary_opts]
        yield f"| {', '.join(f'`{name}`' for name in names)} | {_plain(one.help)} |"
    yield ""


def _plain(text: str | None) -> str:
    """Help as Markdown: brackets that its own markup escaped, and lines that the terminal wraps."""
    text = re.sub(r"\\(?=\[)", "", text or "").replace("\b", "")
    return re.sub(r"(?<!\n)\n(?!\n)", " ", text).strip().replace("|", "\\|").replace("<", "&lt;")
