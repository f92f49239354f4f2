"""A behaviour over classes that ``trade stubs`` wrote; lines with an "error" comment are wrong on purpose."""

from rosie_types import Rosie

import trade
from trade import Handle, Run


def calls() -> list[float]:
    """Services are handles with the types of their arguments and results."""
    rosie = trade.robot("rosie", Rosie, follow=True)
    rosie.head.move_to("left")  # error: not a list
    rosie.head.mov_to([0.3, -0.2])  # error: no such service
    print(rosie.hed)  # error: no such group
    rosie.oven.heat(180.0, "grill")  # error: no such mode
    rosie.oven.heat(180.0, "bake", at={"celsius": 20.0, "at_s": 1.0})
    rosie.head.move_to.with_(deadline_s=60)([0, 1])
    label: str = rosie.head.move_to.label
    untyped: Handle = rosie.head.move_to
    untyped(label)
    return rosie.head.move_to([0.3, -0.2], speed_rad_s=0.5)


def starts() -> list[float]:
    """A call that does not wait keeps the types."""
    rosie = trade.robot("rosie", Rosie)
    run: Run[list[float]] = rosie.head.move_to.start([0.3, -0.2])
    rosie.head.move_to.start([0.3, -0.2], speed_rad_s="fast")  # error: not a number
    wrong: int = run.result()  # error: a list
    print(wrong)
    return run.result()


async def awaits() -> list[float]:
    """So does a call from asyncio."""
    rosie = trade.robot("rosie", Rosie)
    wrong: str = await rosie.oven.temperature.acall()  # error: a record
    print(wrong)
    there = await rosie.head.move_to.start([0.3, -0.2])
    there = await trade.acall(rosie.head.move_to, there)
    return await rosie.head.move_to.acall(there)


def reads() -> float:
    """A record has the attributes of its fields, and can be an argument again."""
    rosie = trade.robot("rosie", Rosie)
    reading = rosie.oven.temperature()
    wrong: str = reading.celsius  # error: a float
    print(wrong, reading.kelvin)  # error: no such field
    rosie.oven.heat(reading.celsius, at=reading)
    return reading.celsius


def others() -> None:
    """A name that is no attribute is an index; a word of Python has an underscore; a group cannot be changed."""
    rosie = trade.robot("rosie", Rosie)
    rosie["left-arm"].heat(180.0)
    rosie["left-arm"].heat("hot")  # error: not a number
    rosie.class_.heat(180.0)
    rosie["head.move_to"]([0.3, -0.2])
    rosie.head = rosie.head  # error: it cannot be set
    trade.robot("rosie").any.attribute("at all")


def as_handles() -> None:
    """Typed handles go where handles go."""
    rosie = trade.robot("rosie", Rosie)
    with trade.lock([rosie.head.move_to, rosie.oven.heat]), trade.stream(rosie.oven.temperature) as readings:
        next(readings)
    trade.call_all([rosie.head.move_to.bind([0.3, -0.2]), rosie.oven.temperature])
    rosie.head.move_to.bind("left")  # error: not a list
