"""When a gateway reports that it is alive: while it takes calls and supervises its children."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from trade_gateway.cli.robots._gateway import Gateway
from trade_gateway.config._gateway_file import read_gateway_file

pytestmark = pytest.mark.realtime


@pytest.fixture
def running(system: str, tmp_path: Path) -> Iterator[Gateway]:
    file = tmp_path / "gateway.toml"
    file.write_text(f'system = "{system}"\n[container.mind]\nproviders = []\n')
    made = Gateway(file, read_gateway_file(file), "", lambda: None)
    yield made
    made.close()


def test_a_gateway_is_healthy_until_it_takes_no_calls_any_more(running: Gateway) -> None:
    assert running.healthy
    running.container.close()
    assert not running.healthy


def test_a_gateway_is_unhealthy_when_its_supervision_has_ended(running: Gateway) -> None:
    assert running._supervisor is not None
    running._supervisor.close()
    assert running.container.healthy()
    assert not running.healthy
