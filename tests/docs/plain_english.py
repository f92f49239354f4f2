"""A style checker: reports words that this project avoids, in pages, docstrings, comments, messages, help and names.

`python -m tests.docs.plain_english [PATH...]` prints `file:line: "word": use ...` and exits with 1 if it found one.
A line that needs the word (a quotation, the name of a book) ends in `plain: WORD`, as a comment. The product has no
such marks: `KEPT` lists its words by module.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
SEARCHED = (
    "trade", "pytest_trade", "checks", "drivers", "gateway", "hil-sim", "robotfile", "examples", "docs",
    "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "tests",
)  # fmt: skip
PRODUCT = ("trade", "pytest_trade", "checks", "drivers", "gateway", "hil-sim", "robotfile")
AVOIDED = {
    r"told|tells|telling": "notify, report, inform, say",
    r"nobody|no one": "no client, no container, none",
    r"somebody|everybody": "a client, a user, each container, all",
    r"whoever|whosoever": "the client, the caller, anyone who",
    r"anew": "again",
    r"stands(?! for)": "is",
    r"goes on|went on|going on": "continues",
    r"bears|borne": "handles, carries",
    r"mend|mends|mended|mending": "fix, repair",
    r"of (?:ours|yours|theirs)": "our, your, their",
    r"for ever|forever": "permanently, without end",
    r"is there(?! an?\b)": "exists, is present",
    r"what is missed": "what is missing",
    r"himself|herself": "itself",
    r"abroad": "in another system",
    r"passers?-by|passes by": "a short-lived container",
}
KEPT = {
    ("trade/default_system.py", "nobody"),  # the account of that name
    ("trade/_resources/grants.py", "nobody"),  # the owner of a lock without one, as clients see it
    ("trade/protocol/messages.py", "told"),  # a field on the wire
    ("gateway/trade_gateway/clients/_schemas.py", "told"),  # the same at the HTTP gateway
    ("gateway/trade_gateway/config/_children.py", "stands"),  # a key of a file
    ("gateway/trade_gateway/language/_lexicon.py", "nobody"),  # a word that people say
}
"""The words that modules of the product need."""
_WORDS = [(re.compile(rf"\b(?:{words})\b", re.IGNORECASE), advice) for words, advice in AVOIDED.items()]
_NAME_PATTERNS = [*(pattern for pattern, _ in _WORDS), re.compile(r"\b(?:ours|yours|theirs|let go|deeds?)\b")]
_NAME_PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_PROSE_TOKENS = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
_CODE_IN_STRING = re.compile(r"(?<!\{)\{[^{}]*\}")
_CODE_IN_PAGE = re.compile(r"`[^`]*`|\]\([^)]*\)|<[^>]*>|https?://\S+")


def avoided(text: str) -> Iterator[tuple[str, str]]:
    """The avoided words in a piece of prose, each with what to use instead."""
    for pattern, advice in _WORDS:
        for match in pattern.finditer(text):
            if f"plain: {match[0]}" not in text:
                yield match[0], advice


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of prose: comments and strings of a module, and a page without its code."""
    yield from (_of_module if path.suffix == ".py" else _of_page)(path.read_text(encoding="utf-8"))


def _of_module(source: str) -> Iterator[tuple[int, str]]:
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in _PROSE_TOKENS:
            text = _CODE_IN_STRING.sub("", token.string) if re.match("[rR]?[fF]", token.string) else token.string
            for offset, line in enumerate(text.splitlines()):
                number = token.start[0] + offset
                escape = re.search(r"plain: .*", lines[number - 1])
                yield number, f"{line} {escape[0] if escape else ''}"


def defined(path: Path) -> Iterator[tuple[int, str, str]]:
    """The functions, classes, parameters, attributes and variables of a module: line number, line and name."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                name = node.name
            case ast.arg():
                name = node.arg
            case ast.Name(ctx=ast.Store()):
                name = node.id
            case ast.Attribute(ctx=ast.Store()):
                name = node.attr
            case _:
                continue
        yield node.lineno, lines[node.lineno - 1], name


def in_names(path: Path, prefix: str = "") -> Iterator[str]:
    """One line of report for each avoided word in a name with this prefix that a module defines."""
    for number, line, name in defined(path):
        words = " ".join(_NAME_PART.findall(name)).lower() if name.startswith(prefix) else ""
        for match in (match for pattern in _NAME_PATTERNS for match in pattern.finditer(words)):
            if f"plain: {match[0]}" not in line and not _kept(path, match[0]):
                yield f'{path}:{number}: "{match[0]}" in the name {name}: use the term of the field'


def _kept(path: Path, word: str) -> bool:
    whole = path.resolve()
    return whole.is_relative_to(ROOT) and (whole.relative_to(ROOT).as_posix(), word) in KEPT


def _of_page(text: str) -> Iterator[tuple[int, str]]:
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced:
            escape = re.search(r"plain: .*(?=-->)", line)
            yield number, f"{_CODE_IN_PAGE.sub('', line)} {escape[0] if escape else ''}"


def findings(paths: list[Path]) -> Iterator[str]:
    """One line of report for each avoided word."""
    for path in paths:
        for number, line in prose(path):
            for word, advice in avoided(line):
                if _kept(path, word):
                    continue
                yield f'{path}:{number}: "{word}": use {advice}'
        if path.suffix == ".py" and any(path.resolve().is_relative_to(ROOT / package) for package in PRODUCT):
            yield from in_names(path)
        else:
            yield from _names_of_tests(path)


def _names_of_tests(path: Path) -> Iterator[str]:
    if path.name.startswith("test_") and path.suffix == ".py":
        yield from in_names(path, "test_")


def files(roots: list[Path]) -> list[Path]:
    """The modules and pages below some folders, except the list of avoided words itself and its tests."""
    return sorted(
        path
        for root in roots
        for path in ([root] if root.is_file() else root.rglob("*"))
        if path.suffix in (".py", ".md") and not path.stem.endswith("plain_english")
    )


def main(arguments: list[str]) -> int:
    found = list(findings(files([Path(name) for name in arguments] or [ROOT / name for name in SEARCHED])))
    if not arguments:
        found += [line for path in files([ROOT / "tests"]) for line in _names_of_tests(path)]
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
