"""What a product knows of its own kind of container: the table, the command that runs it, and what it needs here."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from msgspec import Struct

PRODUCTS: Final = {"http": "http", "ros": "ros", "record": "recording"}
"""By the key of a table: the folder of the product, whose module ``_container`` has ``KIND``."""


class ContainerKind(ABC):
    """One kind of container. Its value is that of its key in the table: a file's name, or a table of its own."""

    table: type[Struct] | None = None
    """The type of a value that is a table."""
    paths: Sequence[str] = ()
    """Keys of that table whose values are paths."""

    @abstractmethod
    def extras(self, value: Any) -> Iterable[tuple[str, str]]:
        """Returns the extras that must be installed, each with a library that it installs."""

    @abstractmethod
    def words(self, name: str, value: Any, place: Callable[[str], str]) -> list[str]:
        """Returns the words after ``trade`` that start the container; ``place`` gives the path of a named file."""

    def problem(self, value: Any, beside: Callable[[str], Path]) -> str:  # noqa: ARG002 - most have none
        """Returns what is wrong with the value on this host, or an empty text."""
        return ""

    def check(self, value: Any, beside: Callable[[str], Path]) -> None:  # noqa: B027 - most have no files to read
        """Reads the files that the value names. Raises ConfigurationError."""


def kind_of_product(key: str) -> ContainerKind:
    """Returns what a product knows of the containers whose table has that key."""
    return import_module(f"trade_gateway.{PRODUCTS[key]}._container").KIND


def as_options(values: Mapping[str, Sequence[str]]) -> list[str]:
    """Returns the words of options, each of which may have several values."""
    return [word for option, named in values.items() for value in named for word in (option, value)]
