"""A provider that can be moved and created."""

from trade import service


class Counter:
    """It counts its calls."""

    def __init__(self, total: int = 0) -> None:
        self.total = total

    @service
    def count(self) -> int:
        self.total += 1
        return self.total

    def save_state(self) -> int:
        return self.total

    def restore_state(self, state: int) -> None:
        self.total = state
