"""The driver of an arm, attached to a simulated one."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from trade.errors import TradeError
from trade_drivers import AttachedRobot, attach, parse
from trade_hil_sim.ur import HOME

ARM = (Path(__file__).parents[3] / "examples" / "arm.toml").read_text()
# so that a loaded machine does not look like a fault
ARM = ARM.replace('driver = "ur"', 'driver = "ur"\nstale_after_s = 0.8')
AT_HOME = list(HOME)


def attached(undo: ExitStack, host: str, text: str = ARM, **options: Any) -> AttachedRobot:
    """The driver, attached to the controller at this address; it ends with the stack."""
    given = {"register": _ignored, "deregister": _ignored, **options}
    driver = attach(parse(text, "arm.toml"), ports={"ur": host}, **given)
    undo.callback(_close, driver)
    return driver


def _close(driver: AttachedRobot) -> None:
    try:
        driver.close()
    except TradeError as error:  # what closing says is tested where it matters
        print(f"closing: {error}")


def _ignored(*_: object) -> None:
    """Nothing is announced."""
