"""What an operator changes of the system on the dashboard, and a viewer cannot; judged from outside of the page."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from playwright.sync_api import expect

from tests.support.http_clients import Client
from tests.support.policies import EVERYTHING, policy_text
from tests.support.waiting import wait_until
from tests.system.browser.conftest import Browsers, HttpProcess, View
from tests.system.conftest import Program
from trade import Container, Notification, Settings, where
from trade.errors import NoSuchService
from trade.transport.endpoints import free_endpoint

POLICY = policy_text(
    "{own}=all olga=operator vera=viewer",
    all=EVERYTHING,
    operator="read=* call=hall administer=trade,hall",
    viewer="read=*",
)
MODULE = """
from trade import service

class Counter:
    def __init__(self) -> None:
        self.total = 0

    @service
    def count(self) -> int:
        self.total += 1
        return self.total

    def save_state(self):
        return self.total

    def restore_state(self, state) -> None:
        self.total = state
"""
GATEWAY = """
system = "{system}"

[container.worker]
providers = [{{ class = "tiny:Counter", groups = ["hall"] }}]

[container.spare]
providers = []
allow = ["tiny:Counter"]
"""


@dataclass
class Hall:
    """A gateway that supervises a counter in `worker`, and an empty `spare`; and a notification that calls it."""

    here: Container
    notification: Notification

    def count(self) -> int:
        return self.here.find(where(name="count", group="hall"), wait_s=60)()

    def place(self) -> str:
        return self.here.find(where(name="count", group="hall"), wait_s=60).container

    def pid(self, name: str) -> int:
        """The process of a container; 0 without one."""
        return next((info.pid for info in self.here.containers() if info.name == name), 0)


@pytest.fixture
def hall(
    system: str,
    run: Callable[..., Program],
    start_container: Callable[..., Container],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Hall:
    (tmp_path / "policy.toml").write_text(POLICY.format(own=Settings.read().identity))
    monkeypatch.setenv("TRADE_POLICY", str(tmp_path / "policy.toml"))
    (tmp_path / "tiny.py").write_text(MODULE)
    (tmp_path / "gateway.toml").write_text(GATEWAY.format(system=system))
    run("-m", "trade_gateway", "gateway", tmp_path / "gateway.toml", "--json")
    here = start_container("here")
    count = here.find(where(name="count", group="hall"), wait_s=60)
    here.find(where(name="clock", group="trade", container="spare"), wait_s=60)
    return Hall(here, here.every(3600, count))


@pytest.fixture
def http(hall: Hall, run: Callable[..., Program], tmp_path: Path) -> HttpProcess:
    made = HttpProcess(run, tmp_path)
    client = Client(made.url, made.token("olga"))
    wait_until(lambda: client.ask("GET", "/services?group=hall&name=count").body, "it is known")
    return made


def card(view: View, container: str) -> Any:
    """The card of a container, chosen in the graph."""
    view.page.locator(f'.container[data-container="{container}"]').click()
    found = view.page.locator("#container-card")
    expect(found.get_by_role("heading")).to_have_text(f"Container {container}")
    return found


def do(card: Any, action: str, title: str, consequence: str, outcome: str) -> None:
    """Press a button, read what will happen, and confirm it."""
    card.get_by_role("button", name=f"{action} …").click()
    confirm(card, title, consequence, outcome)


def confirm(card: Any, title: str, consequence: str, outcome: str) -> None:
    expect(card.locator(".consequence")).to_contain_text(consequence)
    card.get_by_role("button", name=title, exact=True).click()
    expect(card.locator("output")).to_have_text(f"✓ {outcome}")


def found(newcomer: Container, wait_s: float) -> bool:
    """Whether a container that broadcasts is found by the worker."""
    try:
        newcomer.find(where(name="clock", group="trade", container="worker"), wait_s=wait_s)
    except NoSuchService:
        return False
    return True


def test_an_operator_restarts_moves_switches_and_cancels(
    hall: Hall, browsers: Browsers, start_container: Callable[..., Container]
) -> None:
    olga, before = browsers.view("olga"), hall.pid("worker")
    worker = card(olga, "worker")
    hall.count()
    do(worker, "Restart", "Restart worker", "Ends 1 service of worker", "gateway starts worker again.")
    wait_until(lambda: hall.pid("worker") not in (0, before), "another process")
    assert not psutil.pid_exists(before)
    assert hall.count() == 2  # it has the saved state

    worker.get_by_role("button", name="Move a provider …").click()
    worker.get_by_label("To container").select_option("spare")
    confirm(worker, "Move a provider", "from worker to spare. No device moves.", "hall is in spare now.")
    wait_until(lambda: hall.place() == "spare", "it has moved")
    assert hall.count() == 3

    for number, on in enumerate((True, False, True)):
        word, listens = "on" if on else "off", free_endpoint()
        title = f"Turn discovery {word} in worker"
        do(worker, f"Turn discovery {word}", title, "nothing moves", f"Discovery is {word} in worker.")
        newcomer = start_container(f"newcomer{number}", listen=[listens], connect=[listens])
        newcomer.system.set_broadcast(True)
        assert found(newcomer, 30 if on else 4) is on
        expect(worker.locator("#container-facts")).to_contain_text(f"Discovery{word}")

    row = olga.page.locator("#notification-list tr", has_text="every 3600 s")
    row.get_by_role("button", name="Cancel notification").click()
    question = olga.page.locator("#notification-confirm")
    expect(question).to_contain_text("it no longer calls hall.count")
    assert hall.notification.active
    question.get_by_role("button", name=f"Cancel notification {hall.notification.id}").click()
    wait_until(lambda: not hall.notification.active, "it has ended")
    expect(row).to_have_count(0)


def test_a_viewer_sees_why_each_change_is_refused_and_it_is_refused_past_the_page(
    hall: Hall, browsers: Browsers
) -> None:
    vera, before = browsers.view("vera"), hall.pid("worker")
    worker = card(vera, "worker")
    expect(worker.locator("#container-facts")).to_contain_text("Supervised by")
    expect(worker.locator("#container-rights")).to_contain_text("the right to administer the system (group trade)")
    buttons = worker.locator("#container-actions button")
    assert buttons.count() >= 6
    assert all(buttons.nth(place).is_disabled() for place in range(buttons.count()))
    cancel = vera.page.locator("#notification-list tr", has_text="every 3600 s").get_by_role("button")
    expect(cancel).to_be_disabled()
    expect(cancel).to_have_attribute("title", "Ending them needs the right to administer the system (group trade).")
    asked = [
        ("POST", "/containers/worker/restart", {}),
        ("POST", "/migrate", {"group": "hall", "to": "spare"}),
        ("POST", "/containers/worker/discovery", {"on": True}),
        ("DELETE", f"/notifications/{hall.notification.id}", None),
    ]
    for method, path, body in asked:
        assert vera.page.evaluate(REQUEST, [method, path, body]) == [403, "AccessDenied"], path
    assert (hall.pid("worker"), hall.place(), hall.notification.active) == (before, "worker", True)


def test_the_graph_shows_links_that_exist_marks_groups_and_needs_no_mouse(hall: Hall, browsers: Browsers) -> None:
    vera = browsers.view("vera")
    nodes = vera.page.locator(".graph .container")
    expect(nodes).to_have_count(5)  # the gateway and its two containers, the HTTP gateway, and this test
    assert {"gateway", "worker", "spare", "here", "http"} == set(
        nodes.evaluate_all("all => all.map(one => one.dataset.container)")
    )
    worker = vera.page.locator('.graph .container[data-container="worker"]')
    linked = {info.to for info in hall.here.find(where(name="network", group="trade", container="worker"))().links}
    assert linked
    expect(worker).to_have_attribute("aria-label", f"worker: linked with {', '.join(sorted(linked))}")
    expect(vera.page.locator(".graph .link.found")).to_have_count(0)
    row = vera.page.locator("#container-list tr", has=vera.page.get_by_role("rowheader", name="worker"))
    expect(row).to_contain_text("hall")
    expect(row).to_contain_text(", ".join(sorted(linked)))
    vera.page.get_by_label("Mark").select_option("hall")
    expect(vera.page.locator(".graph .marked")).to_have_attribute("data-container", "worker")
    worker.focus()
    vera.page.keyboard.press("Enter")
    expect(vera.page.get_by_role("heading", name="Container worker")).to_be_visible()
    expect(worker).to_be_focused()
    expect(vera.page.locator(".graph .link.chosen")).to_have_count(len(linked))


def test_a_policy_is_edited_with_a_diff_and_does_not_lock_out_its_editor(browsers: Browsers, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    olga, vera, before = browsers.view("olga"), browsers.view("vera"), policy.read_text()
    expect(vera.page.get_by_role("button", name="Edit policy …")).to_be_disabled()
    expect(vera.page.locator("#edit-rights")).to_contain_text("which vera does not have")
    assert vera.page.evaluate(REQUEST, ["PUT", "/policy/file", {"text": "", "version": ""}]) == [403, "AccessDenied"]

    section = olga.page.locator("#policy")
    section.get_by_role("button", name="Edit policy …").click()
    text, save = section.get_by_label(str(policy)), section.get_by_role("button", name="Save policy")
    expect(text).to_have_value(before)
    expect(save).to_be_disabled()
    text.fill(before.replace('olga = ["operator"]', 'olga = ["viewer"]'))
    section.get_by_role("button", name="Try it").click()
    expect(section.locator("#editor output")).to_contain_text("olga would no longer administer the system")
    expect(save).to_be_disabled()
    text.fill(before.replace('vera = ["viewer"]', 'vera = ["operator"]'))
    section.get_by_role("button", name="Try it").click()
    expect(section.locator(".bullets")).to_contain_text("vera may administer hall, trade.")
    expect(section.locator(".diff .added")).to_have_text('+vera = ["operator"]\n')
    assert policy.read_text() == before
    save.click()
    expect(section.locator("#editor output")).to_contain_text("apply it within two seconds")
    assert policy.read_text() == before.replace('vera = ["viewer"]', 'vera = ["operator"]')
    assert vera.page.evaluate(REQUEST, ["POST", "/containers/worker/discovery", {"on": False}]) == [200, None]


REQUEST = """async ([method, path, body]) => {
    const headers = { Authorization: `Bearer ${sessionStorage.getItem("token")}`, "Content-Type": "application/json" };
    const answer = await fetch(path, { method, headers, body: body && JSON.stringify(body) });
    return [answer.status, (await answer.json()).title ?? null];
}"""
