"""A joint behind a policy, in a system in memory: who may do what to it is in a file that a test may rewrite."""

from pathlib import Path

import pytest

from tests.support.policies import policy_text
from trade import Container, Handle, Resource, service, where

POLICY = policy_text(
    "planner=operator dash=viewer drv=driver chief=chief",
    head='revoked = ["thief"]\n',
    operator="includes=viewer call=rosie.neck lock=rosie.neck",
    viewer="read=rosie",
    driver="register=rosie,lab",
    chief="administer=* register=rosie",
)


class Neck:
    def __init__(self, name: str = "rosie.neck.pan") -> None:
        self.resources = (Resource(name),)
        self.moved: list[float] = []
        self.stops = 0

    @service
    def move(self, angle_rad: float) -> float:
        self.moved.append(angle_rad)
        return angle_rad

    @service(effect="read")
    def angle(self) -> float:
        return 0.5

    @service(effect="stop")
    def stop(self) -> None:
        self.stops += 1


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    return path


def find(container: Container, name: str, group: str = "rosie.neck") -> Handle:
    return container.find(where(name=name, group=group, container="of-drv"))


def rewritten(policy: Path, old: str, new: str) -> Path:
    policy.write_text(policy.read_text().replace(old, new))
    return policy
