"""What each of many containers offers: services as a robot has them."""

from typing import Any, Final

PROVIDERS: Final = 10
"""Objects of each container, beside the middleware's own."""
SERVICES: Final = 10
"""Of each object."""


def fill(container: Any, name: str) -> None:
    """Have it offer all of it."""
    kind = kind_of_arm()
    for number in range(PROVIDERS):
        container.register(kind(), f"robot.{name}.p{number}")


def kind_of_arm(services: int = SERVICES, *, stops: bool = True) -> type:
    """Services as a robot has them: three numbers in, one out, a line of description; the last one may stop."""
    from trade import service

    def halt(self) -> None:
        """Stop."""

    methods = {f"move_{number}": _method(f"move_{number}") for number in range(services)}
    if stops:
        last = f"move_{services - 1}"
        methods[last] = service(effect="stop")(_named(halt, last))
    return type("Arm", (), methods)


def _method(name: str) -> Any:
    from trade import service

    def move(self, shoulder_rad: float, elbow_rad: float, speed_rad_s: float) -> float:
        """Move both joints; gives the time it takes, in seconds."""
        return 0.0

    return service(_named(move, name))


def _named(function: Any, name: str) -> Any:
    function.__name__ = function.__qualname__ = name
    return function
