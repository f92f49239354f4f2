"""A lamp, for `trade system up examples/system.toml` to make."""

from typing import Annotated

from trade import Meta, service

Level = Annotated[float, Meta(ge=0, le=1, description="fraction of full")]


class Lamp:
    """Its light is a number."""

    def __init__(self, level: float = 0.0) -> None:
        self._level = level

    @service
    def shine(self, level: Level) -> None:
        """Be that bright from now on."""
        self._level = level

    @service(effect="read")
    def level(self) -> Level:
        """How bright it is."""
        return self._level

    def save_state(self) -> float:
        """For when it moves to another container."""
        return self._level

    def restore_state(self, level: float) -> None:
        """Restore the brightness after a migration or restart."""
        self._level = level
