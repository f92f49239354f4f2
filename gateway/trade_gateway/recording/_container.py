"""A container of a configuration file that records."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from trade_gateway.config._kind import ContainerKind, as_options

_Text = Annotated[str, Meta(min_length=1)]


class RecordSpec(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """A recorder: the options of ``trade record``."""

    folder: _Text
    """Each start of the recorder writes a file of its own here; with ``keep_last_s``, each fault does."""
    groups: list[_Text] = []
    services: list[_Text] = []
    """Read-only services to sample, too; ``*`` and ``?`` are wildcards."""
    hz: float | None = None
    camera_hz: float | None = None
    service_hz: float | None = None
    keep_last_s: float | None = None
    """Save only the last seconds before each fault."""


class _RecordContainer(ContainerKind):
    """Its value is a table."""

    table = RecordSpec
    paths = ("folder",)

    def extras(self, value: Mapping[str, Any]) -> Iterable[tuple[str, str]]:  # noqa: ARG002
        return [("record", "mcap")]

    def words(self, name: str, value: Mapping[str, Any], place: Callable[[str], str]) -> list[str]:
        spec = msgspec.convert(value, RecordSpec)
        rates = {"--hz": spec.hz, "--camera-hz": spec.camera_hz, "--service-hz": spec.service_hz}
        options: dict[str, Sequence[str]] = {"--group": spec.groups, "--services": spec.services}
        options |= {option: [f"{hz:g}"] for option, hz in rates.items() if hz is not None}
        words, folder = ["record", "--name", name], place(spec.folder)
        if spec.keep_last_s is None:
            return [*words, f"{folder}/", *as_options(options)]
        return [*words, *as_options(options), "--keep-last", f"{spec.keep_last_s:g}", "--at-fault", folder]


KIND: Final = _RecordContainer()
