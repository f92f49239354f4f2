"""The files of the dashboard, as the HTTP gateway serves them to any client."""

import re
from pathlib import Path

import pytest

from tests.support.http_clients import Client, opened
from trade.testing import memory_system
from trade_gateway.dashboard import pages

pytestmark = pytest.mark.virtual_time

STATIC = Path(__file__).parents[3] / "gateway" / "trade_gateway" / "dashboard" / "static"


def test_the_page_and_its_files_are_public_and_run_no_foreign_script(tmp_path: Path) -> None:
    with memory_system() as system, opened(system.container("me"), tmp_path) as (gateway, _):
        anybody = Client(gateway.url)
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
    with memory_system() as system, opened(system.container("me"), tmp_path) as (gateway, _):
        assert Client(gateway.url).ask("POST", path, {}).status == 405


def test_nothing_in_the_page_comes_from_elsewhere_or_is_inline() -> None:
    page, style = ((STATIC / name).read_text("utf-8") for name in ("index.html", "style.css"))
    scripts = "".join(path.read_text("utf-8") for path in STATIC.glob("*.js"))
    for text in (page, style, scripts.replace("http://www.w3.org/2000/svg", "")):
        assert "http://" not in text
        assert "https://" not in text
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|\sstyle=|javascript:", page)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|localStorage", scripts)


def test_each_module_is_short_is_loaded_with_the_page_and_imports_what_there_is() -> None:
    page = (STATIC / "index.html").read_text("utf-8")
    modules = {path.name: path.read_text("utf-8") for path in STATIC.glob("*.js")}
    assert {path.name for path in STATIC.iterdir()} == {*modules, "index.html", "style.css", "icon.svg"}
    for name, text in modules.items():
        assert len(text.splitlines()) < 400, name
        assert page.count(f'"/dashboard/{name}"') == 1, name
        for imported, source in re.findall(r'^import (.*) from "\./(.*)";$', text, re.MULTILINE):
            for one in imported.strip("{} ").split(", "):
                assert re.search(
                    rf"^export .*\b(function|class|const|let) {re.escape(one)}(?!\w)", modules[source], re.MULTILINE
                )
                assert len(re.findall(rf"(?<![\w.]){re.escape(one)}(?!\w)", text)) > 1, f"{name} does not use {one}"
