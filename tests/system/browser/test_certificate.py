"""Who has a certificate of the system's authority in the browser signs in with it."""

from pathlib import Path

import pytest
from playwright.sync_api import expect, sync_playwright

from tests.support.certificates import Papers
from tests.system.browser.conftest import PATIENCE_MS, chromium
from trade.testing import memory_system
from trade_gateway.http import HttpGateway, Tokens


@pytest.mark.slow
def test_a_certificate_of_the_systems_authority_takes_the_place_of_a_token(tmp_path: Path) -> None:
    papers, executable = Papers(tmp_path / "pki"), chromium()
    folder = papers.of("anna")
    with (
        memory_system() as system,
        HttpGateway(
            system.container("me"),
            listen="127.0.0.1:0",
            tokens=Tokens(None),
            tls=papers.of("http", addresses=["127.0.0.1"]),
        ) as gateway,
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"]) as browser,
    ):
        shown = {"origin": gateway.url, "certPath": folder / "cert.pem", "keyPath": folder / "key.pem"}
        # the browser does not know the test's authority; the test is whom the HTTP gateway lets in
        anna = browser.new_context(ignore_https_errors=True, client_certificates=[shown]).new_page()  # type: ignore[list-item]
        anna.goto(gateway.url, timeout=PATIENCE_MS)
        expect(anna.locator("#connection")).to_have_text("● Connected as anna", timeout=PATIENCE_MS)
        expect(anna.get_by_role("button", name="Sign out")).to_be_hidden()
        stranger = browser.new_context(ignore_https_errors=True).new_page()
        stranger.goto(gateway.url, timeout=PATIENCE_MS)
        expect(stranger.get_by_label("Token")).to_be_visible(timeout=PATIENCE_MS)
