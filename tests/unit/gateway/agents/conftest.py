"""The robot, the agent and what the policy lets it do."""

from pathlib import Path

import pytest

from tests.unit.gateway.agents.agent_rig import POLICY, Robot
from trade import Container
from trade.testing import MemorySystem


@pytest.fixture
def robot(memory: MemorySystem) -> Robot:
    return Robot(memory.container("robot", identity="robot"))


@pytest.fixture
def agent(memory: MemorySystem, robot: Robot) -> Container:
    made = memory.container("agent", identity="agent")
    memory.settle()
    return made


@pytest.fixture
def governed(memory: MemorySystem, robot: Robot, agent: Container, tmp_path: Path) -> Path:
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY)
    for container in (robot.container, agent):
        container.load_policy(policy)
    return policy
