"""The driver of an arm, attached to a simulated one."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.support.fake_container import fake_container
from trade.errors import TradeError
from trade_drivers import AttachedRobot, attach, parse
from trade_hil_sim.ur import HOME

ARM = (Path(__file__).parents[3] / "examples" / "arm.toml").read_text()
# so that a loaded machine does not look like a fault
ARM = ARM.replace('driver = "ur"', 'driver = "ur"\nstale_after_s = 0.8')
AT_HOME = list(HOME)


def attached(undo: ExitStack, host: str, text: str = ARM, **options: Any) -> AttachedRobot:
    """The driver, attached to the controller at this address; it ends with the stack."""
    driver = attach(parse(text, "arm.toml"), fake_container(**options), ports={"ur": host})
    undo.callback(_close, driver)
    return driver


def _close(driver: AttachedRobot) -> None:
    try:
        driver.close()
    except TradeError as error:  # what closing says is tested where it matters
        print(f"closing: {error}")
