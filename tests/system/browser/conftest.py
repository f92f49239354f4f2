"""The dashboard in a real Chromium, of a simulated robot behind an HTTP gateway in a process of its own."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.support.http_clients import Client
from tests.support.policies import EVERYTHING, policy_text
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import Bench, Program, bench, benches, run
from trade import Settings
from trade_gateway.http import add_token

__all__ = ["bench", "benches", "run"]

POLICY = policy_text(
    "{own}=all chief=all anna=operator bert=operator vera=viewer",
    all=EVERYTHING,
    operator="read=* call=rosie lock=rosie",
    viewer="read=rosie",
)
PAN = "rosie.neck.pan"
PATIENCE_MS = PATIENCE_S * 1000


def chromium() -> str:
    """Where it is; skips where there is none, and fails there in CI."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None and os.environ.get("CI") == "true":
        pytest.fail("no chromium (Debian: apt-get install chromium); in CI this is part of what must hold")
    if found is None:
        pytest.skip("no chromium (Debian: apt-get install chromium)")
    return found


class HttpProcess:
    """``trade http`` with a policy, that can be killed and started again at the same address."""

    def __init__(self, run: Callable[..., Program], folder: Path) -> None:
        self._run, self._tokens = run, folder / "tokens.toml"
        self.token("stranger")
        self.url = ""
        self.start("127.0.0.1:0")

    def start(self, listen: str = "") -> None:
        words = ("--listen", listen or self.url.removeprefix("http://"), "--tokens", self._tokens, "--json")
        self.program = self._run("-m", "trade_gateway", "http", *words)
        self.url = self.program.json()["url"]

    def token(self, identity: str) -> str:
        return add_token(self._tokens, identity)


@pytest.fixture
def http(
    bench: Bench,
    run: Callable[..., Program],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> HttpProcess:
    (tmp_path / "policy.toml").write_text(POLICY.format(own=Settings.read().identity))
    monkeypatch.setenv("TRADE_POLICY", str(tmp_path / "policy.toml"))
    monkeypatch.setenv("TRADE_AUDIT", str(tmp_path / "audit"))
    made = HttpProcess(run, tmp_path)
    client = Client(made.url, made.token("chief"))
    wait_until(lambda: client.ask("GET", f"/services?group={PAN}&name=state").body, "it is known")
    return made


class View:
    """A user's page: what can be seen and done there."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.link = page.locator("#link")
        self.stopped = page.locator("#stopped")
        self.estop = page.get_by_role("button", name="E-STOP")
        self.pan = page.locator(f'[id="at-{PAN}"]')
        self.plus = self.pan.get_by_role("button", name="in the positive direction")
        self.stop = self.pan.get_by_role("button", name="Stop")
        self.minus = self.pan.get_by_role("button", name="in the negative direction")
        self.message = self.pan.get_by_role("status")

    def hold(self, what: Any) -> None:
        """Press with the mouse and do not let go; again if a service appeared, as the page is then built again."""

        def taken() -> bool:
            expect(what).to_be_enabled()
            what.scroll_into_view_if_needed()
            what.hover()
            self.page.mouse.down()
            if what.evaluate("button => button === document.activeElement"):
                return True
            self.page.mouse.up()
            return False

        wait_until(taken, "the button takes the press")

    def sign_in(self, token: str) -> None:
        self.page.get_by_label("Token").fill(token)
        self.page.keyboard.press("Enter")

    def service(self, group: str, name: str) -> Any:
        """The card of a service, open."""
        self.page.get_by_label("Search").fill(f"{group}.{name}")
        card = self.page.locator(f'[data-service="{group}.{name}"]')
        card.locator("summary").click()
        return card


class Browsers:
    """Chromium, once or several times."""

    def __init__(self, start: Callable[[], Browser], http: HttpProcess) -> None:
        self._start = start
        self._http = http
        self._first: Browser | None = None

    def view(self, who: str, *, alone: bool = False, **options: Any) -> View:
        """A page of a signed-in user; ``alone``: in a browser of its own."""
        if alone or self._first is None:
            browser = self._start()
            self._first = self._first or browser
        else:
            browser = self._first
        page = browser.new_context(viewport={"width": 1280, "height": 900}, **options).new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.goto(self._http.url)
        view = View(page)
        view.sign_in(self._http.token(who))
        expect(view.link).to_have_text("● Connected")
        return view


@pytest.fixture
def browsers(http: HttpProcess) -> Iterator[Browsers]:
    executable = chromium()
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        started: list[Browser] = []

        def start() -> Browser:
            # the sandbox needs user namespaces, which containers of CI seldom have; only our own page is shown
            browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
            started.append(browser)
            return browser

        yield Browsers(start, http)
        for browser in started:
            with suppress(Exception):  # it was killed by its test
                browser.close()


def renderers() -> list[psutil.Process]:
    """The processes that run pages, of all browsers of this one."""
    found = psutil.Process().children(recursive=True)
    return [one for one in found if "--type=renderer" in one.cmdline()]
