"""A simulated arm in a thread of this process, and the driver attached to it."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from trade.errors import TradeError
from trade_drivers import AttachedRobot, attach, parse
from trade_hil_sim import Arm, UrBus
from trade_hil_sim.ur import HOME

ARM = (Path(__file__).parent.parent / "examples" / "arm.toml").read_text()
# so that a loaded machine does not look like a fault
ARM = ARM.replace('driver = "ur"', 'driver = "ur"\nstale_after_s = 0.8')
AT_HOME = list(HOME)


def attached(
    undo: ExitStack, arm: Arm | None = None, *, host: str = "", text: str = ARM, **options: Any
) -> tuple[UrBus, AttachedRobot]:
    """A controller with this arm, and the driver on it, or on another address; both end with the stack."""
    robot = parse(text, "arm.toml")
    sim = undo.enter_context(UrBus(arm or Arm(name="right", unlock_s=0.3), name="ur"))
    given = {"register": _ignored, "deregister": _ignored, **options}
    driver = attach(robot, ports={"ur": host or sim.port}, **given)
    undo.callback(_close, driver)
    return sim, driver


def _close(driver: AttachedRobot) -> None:
    try:
        driver.close()
    except TradeError as error:  # what closing says is tested where it matters
        print(f"closing: {error}")


def _ignored(*_: object) -> None:
    """Nothing is announced."""
