"""The files of the dashboard, as the door gives them to whoever asks."""

import re
from pathlib import Path

import pytest

from doors import Client, opened
from trade.testing import memory_system
from trade_gateway.dashboard import pages

STATIC = Path(__file__).parents[2] / "gateway" / "src" / "trade_gateway" / "dashboard" / "static"


def test_the_page_and_what_it_needs_are_given_to_everybody_and_run_no_script_but_their_own(tmp_path: Path) -> None:
    with memory_system() as system, opened(system.container("me"), tmp_path) as (door, _):
        anybody = Client(door.url)
        page = anybody.ask("GET", "/")
        needed = re.findall(r'(?:src|href)="(/[^"]+)"', page.body.decode())
        assert {"/dashboard/app.js", "/dashboard/style.css", "/dashboard/icon.svg"} <= set(needed)
        for path in ("/", *needed):
            answer = anybody.ask("GET", path)
            assert answer.status == 200, path
            policy = answer.headers["content-security-policy"].split("; ")
            assert {"default-src 'self'", "frame-ancestors 'none'", "base-uri 'none'"} <= set(policy)
            assert "unsafe" not in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.headers["referrer-policy"] == "no-referrer"
            assert "set-cookie" not in answer.headers
            again = anybody.ask("GET", path, If_None_Match=answer.headers["etag"])
            assert (again.status, again.body) == (304, b"")


@pytest.mark.parametrize("path", [route.path for route in pages()])
def test_a_page_of_the_dashboard_is_only_read(tmp_path: Path, path: str) -> None:
    with memory_system() as system, opened(system.container("me"), tmp_path) as (door, _):
        assert Client(door.url).ask("POST", path, {}).status == 405


def test_nothing_in_the_page_comes_from_elsewhere_or_is_inline() -> None:
    page, script, style = ((STATIC / name).read_text("utf-8") for name in ("index.html", "app.js", "style.css"))
    for text in (page, style, script.replace("http://www.w3.org/2000/svg", "")):
        assert "http://" not in text
        assert "https://" not in text
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|\sstyle=|javascript:", page)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|localStorage", script)
