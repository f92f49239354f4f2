"""A lock that is passed on in the environment: what carries it, and what happens once its holder is gone."""

import os
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.two_joint_robot import Joint
from trade import Container, Settings, service, where
from trade.errors import ConfigurationError, LockedByOther, LockLost, Stopped

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]


class Lamp:
    @service
    def dim(self, value: float) -> float:
        return value

    @service(effect="read")
    def value(self) -> float:
        return 0.0


CHILD = """
    import threading
    with Container(Settings.read(container="child")) as container:
        dim = container.find(where(name="dim"), wait_s=20)
        def tell():
            try:
                say(dim(0.5))
            except Exception as error:
                say(type(error).__name__)
        while hear() != "end":
            thread = threading.Thread(target=tell)
            thread.start()
            thread.join()
"""


@pytest.fixture
def lamp(there: Container) -> Container:
    there.register(Lamp(), "hall")
    return there


@pytest.mark.realtime
def test_a_child_calls_under_the_lock_of_its_parent_until_it_is_given_back(
    lamp: Container, here: Container, start_program: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    here.find(where(name="dim"), wait_s=20)
    with here.lock(where(group="hall"), purpose="show") as lock:
        [(name, text)] = lock.environment().items()
        monkeypatch.setenv(name, text)
        child = start_program(CHILD)
        monkeypatch.delenv(name)
        other = start_program(CHILD)
        for program, answer in ((child, "0.5"), (other, LockedByOther.__name__)):
            program.tell("go")
            assert program.heard() == answer
    for program, answer in ((child, LockLost.__name__), (other, "0.5")):
        program.tell("go")
        assert program.heard() == answer
        program.tell("end")
        assert program.ends() == 0


def test_S08_a_child_resumes_as_the_owner_of_the_lock_does(
    there: Container, here: Container, start_container: Callable[..., Container], eventually: Eventually
) -> None:
    joint = Joint()
    there.register(joint, "hall")
    move = here.find(where(name="move"), wait_s=20)
    with here.lock(where(group="hall"), purpose="go") as lock:
        child = start_container("child", environment={**os.environ, **lock.environment()})
        other = start_container("other")
        other.find(where(name="stop", group="hall"), wait_s=20)()
        with pytest.raises(Stopped):
            move(0.1)
        with pytest.raises(LockedByOther):
            other.resume(where(group="hall"))
        child.find(where(name="move"), wait_s=20)
        assert child.resume(where(group="hall")) == ["joint"]
        assert move(0.1) == 0.1


def test_once_the_holder_is_gone_nothing_is_sent(
    lamp: Container, start_container: Callable[..., Container], eventually: Eventually
) -> None:
    holder = start_container("holder")
    holder.find(where(name="dim"), wait_s=20)
    lock = holder.lock(where(group="hall")).acquire()
    child = start_container("child", environment={**os.environ, **lock.environment()})
    dim = child.find(where(name="dim"), wait_s=20)
    assert dim(0.5) == 0.5
    assert eventually(lambda: "holder" in [info.name for info in child.containers()])
    holder.close()
    assert eventually(lambda: "holder" not in [info.name for info in child.containers()])
    with pytest.raises(LockLost, match="holder, which held it, has ended"):
        dim(0.5)
    assert child.find(where(name="value"))() == 0.0


@pytest.mark.parametrize("text", ["yes", "[]", '[["a"], [], []]', '[["a", "b", "c"], [], [[1]]]', "7"])
def test_what_is_no_lock_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="TRADE_LOCK: is what `trade lock` passes"):
        Container(Settings.read(system="nowhere", environment={"TRADE_LOCK": text}))
