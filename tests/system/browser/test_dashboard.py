"""What people do on the dashboard, in a real browser; of motion the simulator's log is the judge (S03, S04, S08)."""

import re
import signal
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

import trade
from tests.conftest import StartContainer
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.browser.conftest import PAN, Browsers, HttpProcess, View, renderers
from tests.system.conftest import Bench
from trade import service
from trade.transport.endpoints import free_endpoint
from trade_hil_sim import events

LEAST_RAD = 0.02
"""What is more than noise."""
MOST_RAD = 1.0
"""An angle that a joint does not reach if it stops soon after its page releases the button: its range ends at 1.4."""
LOOKS = 200
"""Lines of the simulator's log; there are several in each of the driver's cycles."""


def pan_rad(bench: Bench) -> float:
    devices = [device for bus in bench.sim.control.state() for device in bus.devices if device.joint == "neck.pan"]
    return devices[0].position_rad


def jog(bench: Bench, view: View, button: Any) -> None:
    """Hold a button until the joint has moved its way; a refused page, as on a busy computer, presses again."""
    began, sign = pan_rad(bench), 1 if button is view.plus else -1

    def moved() -> bool:
        if button.get_attribute("aria-pressed") == "false":
            view.page.mouse.up()
            view.hold(button)
        return (pan_rad(bench) - began) * sign > LEAST_RAD

    view.hold(button)
    wait_until(moved, "the joint moves")


def comes_to_rest(bench: Bench) -> None:
    """It comes to rest and stays, short of the end of its range, where a jog that continued would get."""

    def stayed() -> bool:
        at, looked = pan_rad(bench), len(bench.sim.entries())
        wait_until(lambda: len(bench.sim.entries()) > looked + LOOKS)
        return pan_rad(bench) == pytest.approx(at, abs=1e-3)

    wait_until(stayed, "the joint is at rest")
    assert abs(pan_rad(bench)) < MOST_RAD
    assert not events(bench.sim.entries(), "watchdog_expired")


def test_a_joint_moves_while_its_button_is_held_and_no_longer(bench: Bench, browsers: Browsers) -> None:
    anna = browsers.view("anna")
    jog(bench, anna, anna.plus)
    anna.page.mouse.up()
    comes_to_rest(bench)
    expect(anna.page.locator("#lock-list")).to_have_text("Nothing is locked.")


@pytest.mark.parametrize("key", ["Space", "Enter"])
def test_a_joint_moves_while_a_key_is_held_on_its_button(bench: Bench, browsers: Browsers, key: str) -> None:
    anna = browsers.view("anna")

    def moved() -> bool:
        if anna.minus.get_attribute("aria-pressed") == "false":  # not yet, or refused on a busy computer
            anna.page.keyboard.up(key)
            anna.minus.focus()
            anna.page.keyboard.down(key)
        return pan_rad(bench) < -LEAST_RAD

    wait_until(moved, "the joint moves")
    anna.page.keyboard.up(key)
    comes_to_rest(bench)


@pytest.mark.parametrize("what", ["blur", "pagehide", "visibilitychange"])
def test_a_page_that_is_left_moves_nothing(bench: Bench, browsers: Browsers, what: str) -> None:
    anna = browsers.view("anna")
    jog(bench, anna, anna.plus)
    anna.page.evaluate("what => (what === 'visibilitychange' ? document : window).dispatchEvent(new Event(what))", what)
    comes_to_rest(bench)  # although the mouse button is still down
    expect(anna.plus).to_have_attribute("aria-pressed", "false")


def test_S03_a_page_that_is_closed_moves_nothing(bench: Bench, browsers: Browsers) -> None:
    anna = browsers.view("anna")
    jog(bench, anna, anna.plus)
    anna.page.close()
    comes_to_rest(bench)


def test_S04_a_page_that_is_frozen_moves_nothing(bench: Bench, browsers: Browsers) -> None:
    anna = browsers.view("anna")
    jog(bench, anna, anna.plus)
    frozen = renderers()
    assert frozen
    for process in frozen:
        process.send_signal(signal.SIGSTOP)
    try:
        comes_to_rest(bench)
    finally:
        for process in frozen:
            process.send_signal(signal.SIGCONT)


def test_a_user_without_the_lock_moves_nothing_and_sees_its_owner(bench: Bench, browsers: Browsers) -> None:
    anna, bert = browsers.view("anna"), browsers.view("bert")
    jog(bench, anna, anna.plus)
    expect(bert.pan.locator(".locked")).to_contain_text("for anna")
    bert.hold(bert.minus)
    expect(bert.message).to_contain_text("LockedByOther")
    bert.page.mouse.up()
    was = pan_rad(bench)
    wait_until(lambda: pan_rad(bench) > was + LEAST_RAD, "anna's continues")
    anna.page.mouse.up()
    comes_to_rest(bench)
    expect(bert.pan.locator(".locked")).not_to_contain_text("for anna")
    jog(bench, bert, bert.minus)
    bert.page.mouse.up()
    comes_to_rest(bench)


@pytest.mark.parametrize("label", ["Search", "Only with", "Purpose", "Mark"])
def test_esc_in_a_field_leaves_the_field_and_the_second_one_is_the_e_stop(
    bench: Bench, browsers: Browsers, label: str
) -> None:
    chief = browsers.view("chief")
    field = chief.page.get_by_label(label, exact=True).first
    field.focus()
    chief.page.keyboard.press("Escape")
    expect(field).not_to_be_focused()
    expect(chief.page.locator("#notice")).to_have_text("You have left the field. Press Esc again for the e-stop.")
    expect(chief.stopped).to_be_empty()
    assert trade.estops() == []
    chief.page.keyboard.press("Escape")
    expect(chief.stopped).to_contain_text("Confirmed by")
    assert len(trade.estops()) == 1


def test_esc_in_a_field_is_the_e_stop_while_a_call_of_the_page_moves_something(
    bench: Bench, browsers: Browsers
) -> None:
    chief = browsers.view("chief")
    card = chief.service(PAN, "move_to")
    card.get_by_label("position_rad").fill("1.3")
    card.get_by_label("speed_rad_s").fill("0.1")
    chief.page.keyboard.press("Enter")
    wait_until(lambda: pan_rad(bench) > LEAST_RAD, "the joint moves")
    expect(card.get_by_label("speed_rad_s")).to_be_focused()
    chief.page.keyboard.press("Escape")
    comes_to_rest(bench)
    expect(chief.stopped).to_contain_text("Confirmed by")


def test_an_e_stop_from_the_second_page_stops_what_the_first_moves(bench: Bench, browsers: Browsers) -> None:
    anna, chief = browsers.view("anna"), browsers.view("chief")
    jog(bench, anna, anna.plus)
    chief.page.keyboard.press("Escape")
    comes_to_rest(bench)
    expect(chief.stopped).to_contain_text("Confirmed by")
    expect(chief.stopped.locator("strong")).to_have_text("E-STOP: nothing moves until it is cleared.")
    expect(anna.stopped).to_contain_text("chief: dashboard")
    expect(anna.stopped.locator("strong")).to_have_text(
        "E-STOP: robots that have received it do not move until it is cleared. "
        "This page does not know whether all of them have received it."
    )
    anna.page.mouse.up()
    expect(anna.stopped.get_by_role("button")).to_have_count(0)  # she does not administer the system
    at = pan_rad(bench)
    anna.hold(anna.plus)
    expect(anna.message).to_contain_text("Stopped")
    anna.page.mouse.up()
    assert pan_rad(bench) == pytest.approx(at, abs=1e-3)
    chief.page.get_by_role("button", name="Clear the e-stop").click()
    expect(anna.stopped).to_be_empty()
    anna.hold(anna.plus)
    expect(anna.message).to_contain_text("Stopped")  # it was moving: a client has to resume it
    anna.page.mouse.up()
    anna.pan.get_by_role("button", name="Let it move again").click()
    expect(anna.message).to_have_text("It may move again.")
    jog(bench, anna, anna.plus)
    anna.page.mouse.up()
    comes_to_rest(bench)


def test_S09_an_e_stop_that_no_robot_confirmed_never_says_that_nothing_moves(
    browsers: Browsers, http: HttpProcess, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nowhere = free_endpoint()
    http.program.signal(signal.SIGKILL)
    monkeypatch.setenv("TRADE_CONNECT", nowhere)
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(tmp_path / "elsewhere"))  # where no robot has its stop line
    http.start()
    chief = browsers.view("chief")
    expect(chief.page.locator("#apart")).to_contain_text(f"The HTTP gateway reaches no container at {nowhere}")
    expect(chief.page.locator("#apart")).to_contain_text("nothing accepts connections there")
    expect(chief.page.locator("#apart")).to_contain_text("no robot receives an e-stop")
    expect(chief.page.locator("#robot-list")).to_contain_text("There is no robot")
    chief.page.keyboard.press("Escape")
    loudest = chief.stopped.locator("strong")
    expect(loudest).to_contain_text("CONFIRMED")  # at once, and as long as it is tried
    expect(loudest).to_have_text("✕ NO ROBOT CONFIRMED: use the switch that cuts the power.")
    expect(chief.stopped).to_contain_text("chief: dashboard")
    expect(chief.stopped).not_to_contain_text("nothing moves")


def test_a_page_reconnects_when_the_http_gateway_is_back(bench: Bench, browsers: Browsers, http: HttpProcess) -> None:
    anna = browsers.view("anna")
    jog(bench, anna, anna.plus)
    http.program.signal(signal.SIGKILL)
    comes_to_rest(bench)
    expect(anna.link).to_contain_text("Not connected")
    expect(anna.plus).to_be_disabled()
    anna.page.mouse.up()
    asked: list[Any] = []
    anna.page.route("**/services", lambda route: asked.append(route))  # noqa: PLW0108 - it is inspected
    with anna.page.expect_request("**/services", timeout=PATIENCE_S * 1e3):
        http.start()
    expect(anna.link).to_have_text("● Connected")
    expect(anna.stop).to_be_enabled()
    expect(anna.plus).to_be_disabled()
    asked[-1].abort()
    anna.page.unroute("**/services")  # it asks again
    expect(anna.plus).to_be_enabled()
    jog(bench, anna, anna.plus)
    anna.page.mouse.up()
    comes_to_rest(bench)


def test_a_read_only_client_can_act_only_by_the_e_stop(bench: Bench, browsers: Browsers) -> None:
    vera = browsers.view("vera")
    expect(vera.pan.locator(".figures")).to_contain_text("rad/s")
    for jog in (vera.plus, vera.minus):
        expect(jog).to_be_disabled()
    expect(vera.pan.locator(".badges")).to_contain_text("look only")
    card = vera.service(PAN, "move_to")
    expect(card.get_by_role("button", name="Call")).to_be_disabled()
    vera.page.get_by_label("Group").fill("rosie.head")
    vera.page.get_by_role("button", name="Lock", exact=True).click()
    expect(vera.page.locator("#lock-problem")).to_contain_text("AccessDenied")
    vera.estop.click()
    expect(vera.stopped).to_contain_text("Confirmed by")
    expect(vera.stopped).to_contain_text("Clearing it needs the right to administer the system.")
    assert not events(bench.sim.entries(), "motion_started")


class Hand:
    @service(needs=["see(?thing)", "at(?place)"], achieves=["holding(?thing)"])
    def pick_up(self) -> None: ...


def test_a_service_is_called_by_a_form_made_from_its_schema_and_shows_its_conditions(
    bench: Bench, browsers: Browsers, start_container: StartContainer
) -> None:
    start_container("hand").register(Hand(), "rosie.hand")
    anna = browsers.view("anna")
    hand = anna.service("rosie.hand", "pick_up")
    expect(hand.locator(".note")).to_contain_text(["needs see(?thing), at(?place)", "achieves holding(?thing)"])
    card = anna.service(PAN, "move_to")
    card.get_by_label("position_rad").fill("9")
    card.get_by_role("button", name="Call").click()
    expect(card.locator(".result")).to_contain_text("LimitExceeded")
    assert not events(bench.sim.entries(), "motion_started")
    card.get_by_label("position_rad").fill("0.3")
    card.get_by_label("speed_rad_s").fill("1")
    card.get_by_role("button", name="Call").click()
    expect(card.locator(".result")).to_have_text(re.compile(r"→ 0\.(29|30)"))
    assert pan_rad(bench) == pytest.approx(0.3, abs=0.01)
    group = anna.service("rosie.head", "move_to")
    group.get_by_label("positions_rad").fill("[0.1, 0.1")
    group.get_by_role("button", name="Call").click()
    expect(group.locator(".result")).to_contain_text("Not sent")
    group.get_by_label("positions_rad").fill("[0.1, 0.1]")
    group.get_by_role("button", name="Call").click()
    expect(group.locator(".result")).to_contain_text("→ [")


def test_locks_are_taken_requested_and_broken_in_view_of_all_users(browsers: Browsers) -> None:
    anna, chief = browsers.view("anna"), browsers.view("chief")
    anna.page.get_by_label("Group").fill("rosie.head")
    anna.page.get_by_label("Purpose").fill("a portrait")
    anna.page.get_by_role("button", name="Lock", exact=True).click()
    expect(anna.page.locator("#lock-list")).to_contain_text("(this page)")
    seen = chief.page.locator("#lock-list li")
    expect(seen).to_contain_text("a portrait")
    seen.get_by_role("button", name="Ask for it").click()
    expect(seen).to_contain_text("Its owner was asked.")
    seen.get_by_role("button", name="Break …").click()
    seen.get_by_label("Reason").fill("it hangs")
    seen.get_by_role("button", name="Break it").click()
    expect(anna.page.locator("#notice")).to_contain_text("it hangs")
    expect(anna.page.locator("#lock-list")).to_have_text("Nothing is locked.")


def test_a_wrong_token_is_reported_and_another_one_is_accepted(browsers: Browsers, http: HttpProcess) -> None:
    anna = browsers.view("anna")
    anna.page.get_by_role("button", name="Sign out").click()
    anna.sign_in("guess")
    expect(anna.page.locator("#login-problem")).to_contain_text("this token is unknown or revoked")
    anna.sign_in(http.token("bert"))
    expect(anna.page.locator("#who")).to_have_text("as bert")


def test_the_page_fits_a_phone_and_every_control_has_a_name(browsers: Browsers) -> None:
    anna = browsers.view("anna", has_touch=True, color_scheme="dark")
    anna.page.set_viewport_size({"width": 360, "height": 740})
    expect(anna.plus).to_be_visible()
    anna.service(PAN, "move_to")
    assert anna.page.evaluate("document.documentElement.scrollWidth") <= 360
    expect(anna.estop).to_be_in_viewport()
    nameless = anna.page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, textarea, a")]
            .filter((one) => one.checkVisibility())
            .filter((one) => !(one.getAttribute("aria-label") || one.labels?.length || one.textContent.trim()))
            .map((one) => one.outerHTML)"""
    )
    assert nameless == []
