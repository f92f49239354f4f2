"""What the sections of the dashboard tell beside the robots, and to whom: faults, calls, policy, audit."""

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.system.browser.conftest import PAN, Browsers, View
from tests.system.conftest import Bench

OVERLOAD = 0x20
LEAST_CONTRAST = 4.5
"""Of WCAG 2, level AA, for text of any size."""


def part(view: View, name: str) -> Any:
    return view.page.locator(f"#{name}")


@pytest.mark.slow
def test_a_fault_is_shown_with_its_remedy_and_the_user_who_acknowledged_it(bench: Bench, browsers: Browsers) -> None:
    anna, vera = browsers.view("anna"), browsers.view("vera")
    hers, veras = (part(view, "fault-list").locator("tr", has_text="overload") for view in (anna, vera))
    bench.sim.control.hardware_fault(OVERLOAD, [1])
    for view, row in ((anna, hers), (vera, veras)):
        expect(row).to_contain_text("✕ there")
        expect(view.pan.locator(".notes")).to_contain_text("overload")
    expect(veras.get_by_role("button")).to_have_count(0)
    hers.get_by_role("button", name="I have seen: rosie.neck.pan").click()
    expect(veras).to_contain_text("for anna")
    anna.hold(anna.plus)
    expect(anna.message).to_have_text("That fault is in the way. When its cause is gone: Enable.")
    anna.page.mouse.up()
    expect(vera.pan.get_by_role("button", name="Enable")).to_be_disabled()
    anna.pan.get_by_role("button", name="Enable").click()
    expect(anna.pan.locator(".notes")).not_to_contain_text("overload")
    expect(hers).to_contain_text("gone")
    part(anna, "open-faults").check()
    expect(hers).to_have_count(0)


@pytest.mark.slow
def test_finished_calls_are_shown_to_users_who_may_read_the_system(browsers: Browsers) -> None:
    chief, anna, vera = (browsers.view(name) for name in ("chief", "anna", "vera"))
    expect(part(vera, "call-list")).to_contain_text("the right to read the system")
    expect(part(anna, "trace-calls")).to_be_disabled()  # she does not instrument the system
    expect(part(chief, "call-list")).to_have_text("No call has been traced yet.")
    part(chief, "trace-calls").click()
    expect(part(chief, "notice")).to_contain_text("Calls are traced in")
    card = anna.service(PAN, "move_to")
    card.get_by_label("position_rad").fill("9")
    card.get_by_role("button", name="Call").click()
    for view in (chief, anna):
        part(view, "call-search").fill("move_to")
        row = part(view, "call-list").locator("tbody tr")
        expect(row).to_have_count(1)
        expect(row).to_contain_text("rosie.neck.pan.move_to")
        expect(row).to_contain_text("for anna")
        expect(row).to_contain_text("LimitExceeded")
    part(chief, "stop-tracing").click()
    expect(part(chief, "notice")).to_contain_text("Calls are no longer traced in")


def test_readers_of_the_system_see_the_policy_and_only_administrators_see_the_audit(browsers: Browsers) -> None:
    chief, anna, vera = (browsers.view(name) for name in ("chief", "anna", "vera"))
    expect(part(vera, "policy-list")).to_contain_text("the right to read the system")
    bert = part(anna, "policy-list").get_by_role("row", name="bert")
    expect(bert).to_contain_text("operator")
    expect(part(anna, "audit-list")).to_have_text("This needs the right to administer the system.")
    expect(part(anna, "rule-list")).to_have_text("There are no rules.")
    part(chief, "trace-calls").click()
    expect(part(chief, "audit-list").get_by_role("row", name="set_tracing").first).to_contain_text("configure")


@pytest.mark.slow
def test_text_has_enough_contrast_with_its_background(browsers: Browsers, bench: Bench) -> None:
    """As WCAG 2 computes it, of all that is shown, in both schemes; what cannot be pressed is exempt."""
    bench.sim.control.hardware_fault(OVERLOAD, [1])
    chief = browsers.view("chief")
    chief.service(PAN, "move_to")
    expect(part(chief, "fault-list")).to_contain_text("overload")
    expect(part(chief, "policy-list")).to_contain_text("bert")
    chief.page.keyboard.press("Escape")
    expect(chief.stopped).to_contain_text("Confirmed by")
    bench.sim.control.mute()
    expect(chief.page.locator(".device.stale").first).to_be_visible()
    papers = set[str]()
    for scheme in ("light", "dark"):
        chief.page.emulate_media(color_scheme=scheme)
        for way in ("add", "remove"):
            chief.page.evaluate("way => document.body.classList[way]('offline')", way)
            found = chief.page.evaluate(CONTRASTS)
            assert len(found) > 100
            assert [one for one in found if one["contrast"] < LEAST_CONTRAST] == []
        papers.add(chief.page.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert len(papers) == 2  # both were there


@pytest.mark.slow
def test_a_button_has_enough_contrast_while_it_is_held(browsers: Browsers) -> None:
    """Under the pointer, too, which is where it is then."""
    anna = browsers.view("anna")
    anna.hold(anna.plus)
    expect(anna.plus).to_have_attribute("aria-pressed", "true")
    found = [one for one in anna.page.evaluate(CONTRASTS) if one["text"].startswith("+")]
    anna.page.mouse.up()
    assert found
    assert [one for one in found if one["contrast"] < LEAST_CONTRAST] == []


CONTRASTS = """() => {
    const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    const painted = (layers) => {  // as the browser paints them, one over the other
        for (const [colour, opacity] of layers) {
            [context.fillStyle, context.globalAlpha] = [colour, opacity];
            context.fillRect(0, 0, 1, 1);
        }
        return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
    };
    const linear = (one) => one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4;
    const luminance = (rgb) => {
        const [r, g, b] = rgb.map((one) => linear(one / 255));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const above = (one) => one ? [...above(one.parentElement), one] : [];
    const texts = (one) => [...one.childNodes].filter((node) => node.nodeType === 3).map((node) => node.data.trim());
    const own = (one) => texts(one).join("") || one.placeholder || (one.matches("input, select") ? one.value : "");
    const exempt = "button:disabled, datalist, .skip";
    const all = [...document.body.querySelectorAll("*")];
    return all.filter((one) => own(one) && one.checkVisibility() && !one.closest(exempt)).map((one) => {
        const styles = above(one).map((each) => getComputedStyle(each));
        const style = one.placeholder && !one.value ? getComputedStyle(one, "::placeholder") : styles.at(-1);
        const ink = one instanceof SVGElement ? style.fill : style.color;
        const opacity = styles.reduce((so_far, each) => so_far * each.opacity, 1);
        const layers = [["white", 1], ...styles.map((each) => [each.backgroundColor, 1])];
        const [paper, text] = [painted(layers), painted([...layers, [ink, opacity]])].map(luminance);
        const contrast = (Math.max(paper, text) + 0.05) / (Math.min(paper, text) + 0.05);
        return { text: own(one), tag: one.tagName, ink, contrast };
    });
}"""
