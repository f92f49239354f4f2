"""What the dashboard does with grippers, and with arms whose joints are turned by set-points for the whole arm."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.waiting import wait_until
from tests.system.browser.conftest import Browsers, View, renderers
from tests.system.conftest import ROOT, Program
from trade_hil_sim import SimControl

pytestmark = pytest.mark.slow

LEAST_RAD = 0.02
"""What is more than noise."""
MOST_RAD = 1.0
"""Further than it gets, at a twentieth of its speed, while anybody waits here for its end."""


@contextmanager
def robot(run: Callable[..., Program], file: Path) -> Iterator[SimControl]:
    with SimControl(
        run("-m", "trade_gateway", "up", file, "--name", "beside", "--sim", "--json").json()["control"]
    ) as control:
        yield control


def card(view: View, group: str) -> Any:
    found = view.page.locator(f'[id="at-{group}"]')
    expect(found.locator(".figures div").first).to_be_visible()
    return found


def test_S04_a_joint_of_an_arm_turns_while_its_button_is_held_and_by_no_frozen_page(
    browsers: Browsers, run: Callable[..., Program]
) -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
    with robot(run, ROOT / "examples" / "arm.toml") as control:
        chief = browsers.view("chief")
        arm = card(chief, "ada.right")
        control.brown_out()
        expect(arm.locator(".badges")).to_contain_text("brakes on")
        arm.get_by_role("button", name="Power on").click()
        wait_until(lambda: control.arm("right").robot_mode == "IDLE", "it has power")
        arm.get_by_role("button", name="Release brakes").click()
        expect(arm.locator(".badges")).to_contain_text("brakes released")
        wrist = arm.get_by_role("button", name="joint 6 of right in the positive direction")
        began = control.arm("right").positions_rad

        def jog() -> float:
            at = control.arm("right").positions_rad[5]

            def moved() -> bool:
                if wrist.get_attribute("aria-pressed") == "false":  # refused, as on a busy computer
                    chief.page.mouse.up()
                    chief.hold(wrist)
                return control.arm("right").positions_rad[5] > at + LEAST_RAD

            chief.hold(wrist)
            wait_until(moved, "the joint turns")
            return at

        jog()
        chief.page.mouse.up()
        wait_until(lambda: not control.arm("right").moving, "it is at rest")
        at = jog()
        for process in renderers():
            process.send_signal(signal.SIGSTOP)
        try:
            wait_until(lambda: not control.arm("right").moving, "it is at rest")
            ended = control.arm("right").positions_rad
            assert ended[5] < at + MOST_RAD
            assert ended[:5] == pytest.approx(began[:5], abs=1e-2)
        finally:
            for process in renderers():
                process.send_signal(signal.SIGCONT)


def test_a_hand_is_activated_closed_and_opened_by_its_buttons(browsers: Browsers, run: Callable[..., Program]) -> None:
    with robot(run, ROOT / "examples" / "hand.toml") as control:
        anna = browsers.view("anna")
        hand = card(anna, "rosie.left.hand")
        expect(hand.locator(".badges")).to_contain_text("○ not activated")
        hand.get_by_role("button", name="Close left.hand").click()
        expect(hand.locator(".notes")).to_contain_text("activate")
        hand.get_by_role("button", name="Activate").click()
        expect(hand.locator(".badges")).to_contain_text("● activated")
        hand.get_by_role("button", name="Close left.hand").click()
        wait_until(lambda: control.gripper("left.hand").width_m < 0.01, "it closes")
        expect(hand.locator(".figures")).to_contain_text("Width0.")
        hand.get_by_role("button", name="Open left.hand").click()
        wait_until(lambda: control.gripper("left.hand").width_m > 0.05, "it opens")
