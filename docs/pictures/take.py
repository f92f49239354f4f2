"""``make screenshots``: the pictures of README and docs, taken of a simulated rosie as she runs.

Needs Chromium (Debian: ``apt-get install chromium``).
"""

import contextlib
import io
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, expect, sync_playwright
from rich.console import Console

import trade
from trade import where
from trade_gateway.http import add_token

HERE = Path(__file__).parent
ROSIE = HERE.parents[1] / "examples" / "rosie.toml"
PATIENCE_S = 60.0
DESKTOP = {"viewport": {"width": 1280, "height": 960}, "color_scheme": "light"}
PHONE = {"viewport": {"width": 390, "height": 844}, "color_scheme": "dark", "device_scale_factor": 1.5}


@contextlib.contextmanager
def started(*words: str | Path) -> Generator[dict[str, Any]]:
    """``trade WORDS --json``; what it says when it is up."""
    command = [sys.executable, "-m", "trade_gateway", *map(str, words), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            if not (line := process.stdout.readline()):
                sys.exit(f"trade {' '.join(map(str, words))} ended")
            yield json.loads(line)
        finally:
            process.terminate()


def dashboard(browser: Browser, url: str, token: str, name: str, container: str = "", **look: Any) -> None:
    """Sign in, wait until all joints are shown, take the picture; of the section System if a container is named."""
    with contextlib.closing(browser.new_context(**look)) as context:
        page = context.new_page()
        page.goto(url)
        page.get_by_label("Token").fill(token)
        page.keyboard.press("Enter")
        expect(page.locator("#link")).to_have_text("● Connected")
        expect(page.locator('[id="at-rosie.neck.pan"]')).to_be_visible()
        pose()  # a browser that starts holds drivers up, and their servos stop: enabled again, they have no fault
        expect(page.locator("#ailing")).to_have_text("✓ Nothing reports a fault.")  # of everything there is a sample
        expect(page.locator(".device.stale")).to_have_count(0)
        if container:
            page.goto(f"{url}/#system")
            page.locator(f'.container[data-container="{container}"]').click()
            page.get_by_role("button", name="End …").click()
            expect(page.locator(".consequence")).to_be_visible()
            page.locator("#system").evaluate("section => section.scrollIntoView({ behavior: 'instant' })")
        page.screenshot(path=HERE / name)
        print(f"wrote {HERE / name}")


def pose() -> None:
    """Enable the head and an arm, and have them look about."""
    for service, goal in (("rosie.head", [0.4, -0.2]), ("rosie.right.arm", [0.3, -0.4, 0.5, 0.2, 0.0, 0.0])):
        for name, args in (("enable", []), ("move_to", [goal])):
            trade.find(where(name=name, group=service), wait_s=PATIENCE_S).with_(deadline_s=30)(*args)


def terminal(name: str, words: Sequence[str]) -> None:
    """What a command says, as a terminal shows it."""
    said = subprocess.run(
        [sys.executable, "-m", "trade_gateway", *words], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    console = Console(record=True, width=100, file=io.StringIO(), highlight=False)
    console.print(f"[bold]$ trade {' '.join(words)}[/]")
    console.print(said.stdout, markup=False)
    console.save_svg(str(HERE / name), title="trade")
    print(f"wrote {HERE / name}")


def main() -> None:
    executable = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if executable is None:
        sys.exit("no chromium; on Debian: apt-get install chromium")
    os.environ["TRADE_SYSTEM"] = f"pictures-{secrets.token_hex(3)}"
    parts = ("left_arm", "tail", "legs")  # a browser beside all of rosie takes more than two cores
    leave_out = [word for part in parts for word in ("--without", part)]
    expect.set_options(timeout=PATIENCE_S * 1000)
    with tempfile.TemporaryDirectory() as folder:
        tokens = Path(folder) / "tokens.toml"
        token = add_token(tokens, "anna")
        with (
            started("up", ROSIE, "--sim", *leave_out),
            started("http", "--listen", "127.0.0.1:0", "--tokens", tokens) as http,
            sync_playwright() as playwright,
            trade.lock(where(group="rosie.left.hand"), purpose="carry", wait_s=10),
        ):
            browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
            dashboard(browser, http["url"], token, "dashboard.png", **DESKTOP)
            dashboard(browser, http["url"], token, "dashboard-phone.png", **PHONE)
            dashboard(browser, http["url"], token, "dashboard-system.png", "rosie", **DESKTOP)
            browser.close()
            terminal("top.svg", ["top", "--count", "1"])
        trade.close()


if __name__ == "__main__":
    main()
