"""Programs of the pages, run as they stand there in a system of their own."""

import ast
import asyncio
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import pytest

import trade
from tests.docs.blocks import DOCS, Block, Section, blocks
from tests.support.waiting import wait_until
from trade import Container

_WRITTEN: Final = ("rosie_types",)
"""Modules that a command of the page writes."""


class Play:
    """The programs of one section, in one module, as a reader of the page has it there.

    Earlier imports of the page are available. The default container is the reader's; what the page takes for granted,
    ``offer`` has in other containers of the system.
    """

    def __init__(self, section: Section, start_container: Callable[[str], Container]) -> None:
        self.left = section.blocks("python")
        """The blocks that were not run yet."""
        assert self.left, f"there is no program under {section.heading!r} of {section.page}"
        self.module: Any = ModuleType("page")
        exec(_imported_before(section), vars(self.module))
        self._section, self._start = section, start_container
        self._containers: dict[str, Container] = {}

    def container(self, name: str) -> Container:
        """Another container of the system, which the reader's knows."""
        if name not in self._containers:
            self._containers[name] = self._start(name)
            wait_until(lambda: any(info.name == name for info in trade.system.containers()))
        return self._containers[name]

    def offer(self, container: str, provider: object, group: str) -> None:
        """Have another container offer something; the reader's knows of it."""
        handles = self.container(container).register(provider, group)
        wait_until(lambda: set(handles) <= set(trade.services()))

    def run(self, *, with_: dict[str, str] | None = None, **names: Any) -> None:
        """Run all that is left.

        Args:
            with_: text of the page, and what stands for it here.
            names: what the page takes for granted.
        """
        while self.left:
            self.run_next(with_=with_, **names)

    def run_next(self, *, with_: dict[str, str] | None = None, **names: Any) -> None:
        """Run the next block."""
        block = self.left.pop(0)
        vars(self.module).update(names)
        code = self._compiled(block, with_ or {})
        if code.co_flags & inspect.CO_COROUTINE:  # it awaits, as in a notebook
            asyncio.run(eval(code, vars(self.module)))
        else:
            exec(code, vars(self.module))

    def _compiled(self, block: Block, with_: dict[str, str]) -> Any:
        text = block.text
        for before, after in with_.items():
            assert before in text, f"{before!r} is not on the page any more"
            text = text.replace(before, after)
        text = "\n" * (block.line - 1) + text  # a traceback names the page's line
        flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        return compile(text, f"docs/{self._section.page}", "exec", flags, dont_inherit=True)


def _imported_before(section: Section) -> str:
    """What the page's programs above that section import."""
    above: list[str] = []
    for block in blocks(DOCS / section.page, "python"):
        if block.heading == section.heading:
            break
        tree = compile(block.text, section.page, "exec", ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        above += [ast.unparse(node) for node in imports if getattr(node, "module", "") not in _WRITTEN]
    return "\n".join(above)


@pytest.fixture
def play(
    request: pytest.FixtureRequest,
    system: str,
    start_container: Callable[[str], Container],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> Iterator[Play]:
    """The section that the test names; all its programs have to be run."""
    made, failed = Play(request.function.section, start_container), request.session.testsfailed
    monkeypatch.setitem(sys.modules, "page", made.module)
    monkeypatch.chdir(tmp_path)
    yield made
    assert not made.left or request.session.testsfailed > failed, "these were not run"


class Said:
    """What is printed, by whatever thread."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys, self._text = capsys, ""

    @property
    def text(self) -> str:
        """All of it so far."""
        self._text += self._capsys.readouterr().out
        return self._text

    @property
    def lines(self) -> list[str]:
        return self.text.splitlines()


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Said:
    return Said(capsys)
