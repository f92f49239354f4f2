"""A behaviour as a programmer writes it, for mypy and pyright; lines with an "error" comment are wrong on purpose."""

from typing import Protocol

import trade
from trade import Container, Handle, Run, service
from trade_drivers import JointGroup


class Greeter(Protocol):
    """An interface without a class."""

    @service
    def nod(self, times: int = 2) -> int: ...


def positions(container: Container) -> list[float]:
    """The methods of a class that was found have their types."""
    head = container.find(JointGroup, group="rosie.head")
    head.move_to("left")  # error: not a list
    head.mov_to([0.3, -0.2])  # error: no such service
    return head.move_to([0.3, -0.2], speed_rad_s=0.5)


def of_the_default_container() -> int:
    """The functions of ``trade`` have the same types."""
    nods: int = trade.find(Greeter, follow=True).nod(times=3)
    wrong: str = trade.find(Greeter).nod()  # error: an int
    look: Handle = trade.find("rosie.head.move_to")
    look([0.3, -0.2])
    print(wrong)
    return nods


async def without_waiting() -> list[float]:
    """Started and awaited calls keep the types."""
    head = trade.find(JointGroup)
    run: Run[list[float]] = trade.start_call(head.move_to, [0.3, -0.2])
    trade.start_call(head.move_to, speed="fast")  # error: no such argument
    there: list[float] = await trade.acall(head.move_to, [0.0, 0.0])
    wrong: int = await run  # error: a list
    print(wrong)
    return there


def with_more_time_and_as_a_stream() -> None:
    """A handle of a typed service, and a stream of it, keep the types."""
    head = trade.find(JointGroup)
    move = trade.handle_of(head.move_to).with_(deadline_s=60)
    there: list[float] = move([0.3, -0.2])
    move(speed="fast")  # error: no such argument
    with trade.stream(head.state, hz=20) as states:
        rad: float = states.next(1.0).value[0].position_rad
        wrong: str = states.next(1.0).value  # error: states
    print(there, rad, wrong)


def as_an_object() -> None:
    """A robot's attributes are of any type."""
    rosie = trade.robot("rosie")
    rosie.head.move_to([0.3, -0.2])
    with trade.lock("rosie.head"), trade.stream("rosie.head.state") as states:
        next(states)
