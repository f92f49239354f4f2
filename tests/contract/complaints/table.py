"""How a complaint is written down: a check that the product passes, and that a named mutant of it must fail."""

import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.contract.complaints.bodies import KINDS
from tests.support import waiting

__all__ = ["COMPLAINTS", "Row", "complaint"]

_IMPATIENCE_S = 6.0
"""How long a check waits for what a mutant never does; with the product it may take much longer."""

_RUNS = 3
"""A mutant may go unseen once: a busy computer stops a robot, too, and for a reason of its own."""

COMPLAINTS: dict[str, list["Row"]] = {}
"""By test, once its module is imported: what it is shown to fail with."""

Check = Callable[[Any], None]


class Row(NamedTuple):
    """One line of a complaint's table."""

    kind: str
    """What the check is done on: a key of `KINDS`."""
    mutant: Callable[[pytest.MonkeyPatch], None]
    """Makes of the product what naive code would be, or puts a vendor's library in its place."""
    says: str
    """What the check must complain of then: it may not fail for another reason."""


def complaint(
    *rows: tuple[str, Callable[[pytest.MonkeyPatch], None], str], also: tuple[str, ...] = ()
) -> Callable[[Check], Check]:
    """Makes a test of a check: once for each kind, where it must pass, and once for each row, where it must fail.

    ``also`` names kinds that no row is about: the mutant would change the same function.
    """
    table = [Row(*row) for row in rows]
    kinds = dict.fromkeys([*(row.kind for row in table), *also])
    runs = [pytest.param(kind, None, id=f"{kind}-the_product") for kind in kinds]
    runs += [
        pytest.param(row.kind, row, id=f"{row.kind}-{row.mutant.__name__}", marks=pytest.mark.mutant) for row in table
    ]

    def decorate(check: Check) -> Check:
        @pytest.mark.parametrize(("kind", "row"), runs)
        def test(kind: str, row: Row | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
            if row is None:
                with ExitStack() as undo:
                    check(KINDS[kind](tmp_path, undo))
                return
            monkeypatch.setattr(waiting, "PATIENCE_S", _IMPATIENCE_S)
            row.mutant(monkeypatch)
            for number in range(_RUNS):
                folder = tmp_path / str(number)
                folder.mkdir()
                try:
                    with ExitStack() as undo:
                        check(KINDS[kind](folder, undo))
                except AssertionError as complained:
                    assert re.search(row.says, str(complained)), complained
                    return
            pytest.fail(f"the check passes with this mutant, {_RUNS} times")

        COMPLAINTS[check.__name__] = table
        test.__name__, test.__doc__, test.__module__ = check.__name__, check.__doc__, check.__module__
        return test

    return decorate
