"""A container of a configuration file that runs an HTTP gateway."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from trade_drivers import load
from trade_gateway.config._kind import ContainerKind, as_options

_Text = Annotated[str, Meta(min_length=1)]
_Table = Mapping[str, Any]


class HttpSpec(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """An HTTP gateway: the options of ``trade http``."""

    listen: _Text = "127.0.0.1:7080"
    tokens: str = ""
    """The file of tokens: ``trade http token NAME --tokens FILE``."""
    tls: str = ""
    """Folder of the server's certificate."""
    origins: list[_Text] = []
    """Allowed origins of web pages."""
    hosts: list[_Text] = []
    """Further host names of the server."""
    mcp: bool = False
    """Whether it serves agents at ``/mcp``."""
    ask_first: list[_Text] = []
    """Groups in which agents' calls need approval."""
    twin: str = ""
    """The robot file to simulate for agents' dry runs."""


class _HttpContainer(ContainerKind):
    """Its value is a table."""

    table = HttpSpec
    paths = ("tokens", "tls", "twin")

    def extras(self, value: _Table) -> Iterable[tuple[str, str]]:
        return [("http", "uvicorn"), *([("mcp", "mcp")] if _spec(value).mcp else [])]

    def words(self, name: str, value: _Table, place: Callable[[str], str]) -> list[str]:
        spec = _spec(value)
        options: dict[str, Sequence[str]] = {"--listen": [spec.listen], "--origin": spec.origins, "--host": spec.hosts}
        options["--ask-first"] = spec.ask_first
        for option, named in (("--tokens", spec.tokens), ("--tls", spec.tls), ("--twin", spec.twin)):
            options[option] = [place(named)] if named else []
        return ["http", "--name", name, *as_options(options), *(["--mcp"] if spec.mcp else [])]

    def problem(self, value: _Table, beside: Callable[[str], Path]) -> str:
        spec = _spec(value)
        if not (spec.tokens or spec.tls):
            return "no client could log in; name tokens, or tls and its authority's certificates"
        if spec.tokens and not (tokens := beside(spec.tokens)).exists():
            return f"there is no {tokens}; make it: trade http token NAME --tokens {tokens}"
        if (spec.ask_first or spec.twin) and not spec.mcp:
            return "ask_first and twin are for agents; add mcp = true"
        return ""

    def check(self, value: _Table, beside: Callable[[str], Path]) -> None:
        if twin := _spec(value).twin:
            load(beside(twin))


def _spec(value: _Table) -> HttpSpec:
    return msgspec.convert(value, HttpSpec)


KIND: Final = _HttpContainer()
