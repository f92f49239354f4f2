"""A program as if it were of another version of the protocol: ``other_version.py VERSION -m MODULE WORDS...``.

Or ``VERSION SCRIPT WORDS...``. The number is changed in the text of the one module that has it, before TRADE
is imported; all else is as it is.
"""

import runpy
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final

_MODULE: Final = "trade.protocol.messages"
_AS_IT_IS: Final = "PROTOCOL: Final = 1\n"


class _Changed(SourceFileLoader):
    """Of that module; nothing compiled of it is read or kept."""

    version = ""

    def get_code(self, fullname: str) -> CodeType:
        text = Path(self.path).read_text(encoding="utf-8")
        assert text.count(_AS_IT_IS) == 1, f"{self.path} has another line for its version"
        return compile(text.replace(_AS_IT_IS, f"PROTOCOL: Final = {self.version}\n"), self.path, "exec")


class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        found = PathFinder.find_spec(fullname, path, target) if fullname == _MODULE else None
        if found is not None and found.origin is not None:
            found.loader = _Changed(fullname, found.origin)
        return found


def main(version: str, *words: str) -> None:
    _Changed.version = version
    sys.meta_path.insert(0, _Finder())
    del sys.path[0]  # this folder: what is run has nothing to do with it
    if words[0] == "-m":
        sys.argv = [*words[1:]]
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [*words]
        runpy.run_path(words[0], run_name="__main__")


if __name__ == "__main__":
    main(*sys.argv[1:])
