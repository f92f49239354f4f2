"""What a provider remembers: given by ``save_state()`` as plain data, taken by ``restore_state(state)``."""

import threading
from collections.abc import Callable
from typing import Any, Final

BUDGET_S: Final = 5.0
"""How long a provider may take to give or take its state."""


def is_stateful(kind: type) -> bool:
    """Whether objects of a class can give and take their state."""
    return all(callable(getattr(kind, name, None)) for name in ("save_state", "restore_state"))


def save(provider: Any) -> Any:
    """The state of a provider; raises what it raises, and TimeoutError after `BUDGET_S`."""
    return _within_budget(provider.save_state, "save_state")


def restore(provider: Any, state: Any) -> None:
    """Give a provider its state; raises what it raises, and TimeoutError after `BUDGET_S`."""
    _within_budget(lambda: provider.restore_state(state), "restore_state")


def _within_budget(ask: Callable[[], Any], what: str) -> Any:
    """On a thread of its own: what hangs there for ever holds up nobody else."""
    results, errors, over = list[Any](), list[BaseException](), threading.Event()

    def run() -> None:
        try:
            results.append(ask())
        except BaseException as error:  # noqa: BLE001 - raised where it was asked for
            errors.append(error)
        over.set()

    threading.Thread(target=run, name=f"trade-{what}", daemon=True).start()
    if not over.wait(BUDGET_S):
        raise TimeoutError(f"{what} has not ended after {BUDGET_S:g} s")
    for error in errors:
        raise error
    return results[0]
