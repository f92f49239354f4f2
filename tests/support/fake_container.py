"""What `trade_drivers.attach` uses of a container, in parts that a test replaces."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any


def _ignore(*_: object) -> None:
    pass


def fake_container(
    *,
    register: Callable[..., object] = _ignore,
    deregister: Callable[..., object] = _ignore,
    set_health: Callable[..., object] = _ignore,
    healthy: Callable[[], bool] = lambda: True,
    state_dir: Path | None = None,
) -> Any:
    """A container that announces nothing, and keeps nothing without a folder."""
    settings = SimpleNamespace(state_dir=state_dir, system="")
    return SimpleNamespace(
        register=register, deregister=deregister, set_health=set_health, healthy=healthy, settings=settings
    )
