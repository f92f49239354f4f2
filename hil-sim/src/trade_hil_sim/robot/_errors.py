"""The one error of the simulators: something was asked for that they cannot do."""

__all__ = ["SimulationError"]


class SimulationError(ValueError):
    """A simulator was asked for something it cannot do; the message says what would be right."""
