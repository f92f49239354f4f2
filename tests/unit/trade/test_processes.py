"""Starting, ending, interrupting, forking: what a process with containers does at its edges."""

import signal
import subprocess
import sys
import threading
from typing import Any

import pytest

import trade
from tests.support.signals import signal_another_thread
from tests.support.waiting import wait_until
from trade import Container, Settings, service, where
from trade._container import default
from trade.errors import ConfigurationError, NoSuchService

pytestmark = pytest.mark.realtime


class Lamp:
    @service(effect="read")
    def brightness(self) -> float:
        return 0.5


def test_closing_is_idempotent(here: Container) -> None:
    here.close()
    here.close()


def test_closing_waits_until_everything_has_ended(here: Container) -> None:
    links: list[int] = []

    def close() -> None:
        here.close()
        links.append(len([thread for thread in threading.enumerate() if thread.name.startswith("trade-")]))

    threads = [threading.Thread(target=close) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert links == [0] * 4


USES = {
    "register": lambda container: container.register(Lamp()),
    "deregister": lambda container: container.deregister(Lamp()),
    "services": lambda container: container.services(),
    "find": lambda container: container.find(where()),
    "containers": lambda container: container.containers(),
    "joined": lambda container: container.joined(where(), print),
    "left": lambda container: container.left(where(), print),
}


@pytest.mark.parametrize("use", USES.values(), ids=list(USES))
def test_a_closed_container_refuses_every_use(here: Container, use: Any) -> None:
    here.close()
    with pytest.raises(ConfigurationError, match="here: this container is closed; start another one"):
        use(here)
    assert not here.healthy()


@pytest.mark.parametrize("how", ["call", "start"])
@pytest.mark.parametrize("used_before", [False, True])
def test_a_closed_container_refuses_calls_of_its_handles(
    here: Container, there: Container, how: str, used_before: bool
) -> None:
    there.register(Lamp(), "remote")
    here.register(Lamp(), "local")
    handles = [here.find(where(group=group, name="brightness"), wait_s=20) for group in ("local", "remote")]
    if used_before:
        assert [handle() for handle in handles] == [0.5, 0.5]
    here.close()
    for handle in handles:
        with pytest.raises(ConfigurationError, match="this container is closed"):
            handle() if how == "call" else handle.start().result(20)


def test_closing_ends_calls_under_way(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    run = here.find(where(name="pass_through"), wait_s=20).with_(deadline_s=3600).start()
    assert gate.entered.wait(20)
    here.close()
    with pytest.raises(ConnectionError, match=r"container here was lost during a call of robot.pass_through"):
        run.result(20)


def test_closing_frees_blocked_callers(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    handle = here.find(where(name="pass_through"), wait_s=20).with_(deadline_s=3600)
    outcome: list[Any] = []

    def blocked() -> None:
        try:
            outcome.append(handle())
        except Exception as error:  # noqa: BLE001 - the test looks at it
            outcome.append(error)

    thread = threading.Thread(target=blocked)
    thread.start()
    assert gate.entered.wait(20)
    here.close()
    thread.join(20)
    assert isinstance(outcome[0], ConnectionError)


def test_a_container_that_cannot_start_leaves_nothing(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from trade._container import assembly

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(assembly, "RegistryListener", fail)
    with pytest.raises(KeyboardInterrupt):
        Container(Settings.read(container="interrupted"))
    monkeypatch.undo()
    with Container(Settings.read(container="next", system=system)) as following:
        assert [info.name for info in following.containers()] == ["next"]


def test_the_default_container_starts_itself_and_restarts_after_close(system: str) -> None:
    trade.register(Lamp(), "hall")
    first = trade.container()
    assert trade.find(where(name="brightness"))() == 0.5
    trade.close()
    trade.close()
    assert trade.services(where(name="brightness")) == []
    assert trade.container() is not first


def test_the_default_container_starts_once_whichever_thread_is_first(system: str) -> None:
    started: list[Container] = []
    threads = [threading.Thread(target=lambda: started.append(trade.container())) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(set(map(id, started))) == 1


def test_the_default_container_is_started_with_own_settings_before_first_use_only(system: str) -> None:
    assert trade.start(Settings.read(container="mine")).name == "mine"
    with pytest.raises(ConfigurationError, match=r"runs already\. Call trade.start before anything else"):
        trade.start()


FIRST_USES = {
    "register": "trade.register(Lamp())",
    "services": "trade.services()",
    "find": "trade.find(where(name='clock'))",
    "containers": "trade.containers()",
    "joined": "trade.joined(where(), print)",
    "left": "trade.left(where(), print)",
}


@pytest.mark.parametrize("use", FIRST_USES.values(), ids=list(FIRST_USES))
def test_the_default_container_starts_on_first_use_whatever_that_is(system: str, use: str) -> None:
    assert default._default is None
    eval(use, {"trade": trade, "where": where, "Lamp": Lamp, "print": lambda _: None})
    assert default._default is not None
    assert default._default.healthy()


def test_a_look_up_alone_makes_a_program_part_of_the_system(start_program: Any, there: Container) -> None:
    there.register(Lamp(), "hall")
    program = start_program('say(trade.find(where(name="brightness"), wait_s=30)())')
    assert program.heard() == "0.5"
    assert program.ends() == 0
    assert program.errors() == ""


def test_two_programs_have_containers_of_different_names(start_program: Any) -> None:
    programs = [start_program("say(trade.container().name); hear()") for _ in range(2)]
    assert len({program.heard() for program in programs}) == 2


def test_importing_starts_nothing(start_program: Any) -> None:
    program = start_program("import threading; say(threading.active_count(), trade._container.default._default)")
    assert program.heard() == "1 None"


BUSY = """
import threading
one, other = Container(Settings.read(container="one")), Container(Settings.read(container="other"))
class Slow:
    @service
    def wait(self) -> None:
        entered.release()
        threading.Event().wait(1)
    @service
    async def wait_async(self) -> None:
        import asyncio
        entered.release()
        await asyncio.Event().wait()
entered = threading.Semaphore(0)
other.register(Slow(), "robot")
one.joined(where(), lambda handle: None, existing=True)
handles = [one.find(where(name=name), wait_s=20) for name in ("wait", "wait_async")]
for handle in handles:
    def blocked(handle=handle):
        try:
            handle.with_(deadline_s=3600)()
        except ConnectionError:
            pass
    threading.Thread(target=blocked, daemon=True).start()
    handle.with_(deadline_s=3600).start()
for _ in range(4):
    entered.acquire()
"""


def test_a_process_ends_cleanly_under_live_containers_and_blocked_calls(start_program: Any) -> None:
    program = start_program(BUSY + "\nsay('ending')")
    assert program.heard() == "ending"
    assert (program.ends(), program.errors()) == (0, "")


def test_a_process_that_fails_ends_with_its_own_error(start_program: Any) -> None:
    program = start_program(BUSY + "\nraise SystemExit(7)")
    assert (program.ends(), program.errors()) == (7, "")


def test_a_process_may_end_while_another_thread_closes_its_containers(start_program: Any) -> None:
    program = start_program(
        """
        import threading
        containers = [Container(Settings.read(container=f"c{index}")) for index in range(5)]
        threading.Thread(target=lambda: [container.close() for container in containers], daemon=True).start()
        say("ending")
        """
    )
    assert program.heard() == "ending"
    assert (program.ends(), program.errors()) == (0, "")


SENDERS = {
    "to the main thread": lambda program: program.process.send_signal(signal.SIGINT),
    "to another thread": lambda program: signal_another_thread(program.process.pid, signal.SIGINT),
}
"""An interrupt that another thread receives wakes no wait, nor does one that arrives just before the wait."""


@pytest.fixture(params=SENDERS.values(), ids=list(SENDERS))
def interrupt(request: pytest.FixtureRequest) -> Any:
    def send(program: Any) -> None:
        wait_until(program.sleeps, "it waits")
        request.param(program)

    return send


@pytest.mark.parametrize("path", ["local", "transport"])
def test_an_interrupt_ends_a_blocked_call_and_the_next_call_works(
    start_program: Any, here: Container, gate: Any, interrupt: Any, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", str(int(path == "local")))
    here.register(gate, "robot")
    here.register(Lamp(), "robot")
    program = start_program(
        """
        blocked = trade.find(where(name="pass_through"), wait_s=30).with_(deadline_s=3600)
        brightness = trade.find(where(name="brightness"), wait_s=30)
        try:
            blocked()
        except KeyboardInterrupt:
            say("interrupted")
        hear()
        say([brightness() for _ in range(3)], blocked())
        """
    )
    assert gate.entered.wait(30)
    interrupt(program)
    assert program.heard() == "interrupted"
    assert not gate.passed  # else the answer ended the wait
    gate.open.set()
    program.tell()
    assert program.heard() == "[0.5, 0.5, 0.5] through"
    assert program.ends() == 0


def test_an_interrupt_ends_waiting_for_a_started_call_and_for_a_service(
    start_program: Any, here: Container, gate: Any, interrupt: Any
) -> None:
    here.register(gate, "robot")
    program = start_program(
        """
        run = trade.find(where(name="pass_through"), wait_s=30).with_(deadline_s=3600).start()
        for wait in (run.result, lambda: trade.find(where(name="nothing"), wait_s=3600)):
            try:
                say("waiting")
                wait()
            except KeyboardInterrupt:
                say("interrupted")
        """
    )
    for _ in range(2):
        assert program.heard() == "waiting"
        interrupt(program)
        assert program.heard() == "interrupted"
        assert not gate.passed
    assert program.ends() == 0


FORKING = """
import os, threading
class Lamp:
    @service(effect="read")
    def brightness(self) -> float: return 0.5
lamps = trade.register(Lamp(), "hall")
explicit = Container(Settings.read(container="explicit"))
remote = explicit.find(where(name="brightness"), wait_s=20)
remote(); lamps[0]()
if sys.argv[1] == "closed":
    trade.close(); explicit.close()
"""

IN_CHILD = """
def attempt(name, use):
    try:
        use()
        say(name, "worked")
    except trade.errors.ConfigurationError as error:
        say(name, "refused" if "forked" in str(error) else error)
child = os.fork()
if child == 0:
    attempt("look-up", trade.services)
    attempt("new", lambda: Container(Settings.read(container="child")))
    attempt("explicit", explicit.services)
    attempt("remote call", remote)
    attempt("started call", lambda: remote.start().result(5))
    attempt("local call", lamps[0])
    attempt("register", lambda: trade.register(Lamp()))
    explicit.close()
    trade.close()
    {end}
_, status = os.waitpid(child, 0)
say("child", status)
if sys.argv[1] == "open":
    say("parent", remote(), lamps[0]())
    with Container(Settings.read(container="late")) as late:
        say("late", sorted(info.name for info in late.containers()) == sorted(
            ["late", "explicit", trade.container().name]))
"""


@pytest.mark.parametrize("end", ["os._exit(0)", "sys.exit(0)"])
@pytest.mark.parametrize("state", ["open", "closed"])
def test_a_forked_child_refuses_every_use_and_leaves_the_parent_alone(
    start_program: Any, unwatched: str, end: str, state: str
) -> None:
    program = start_program(FORKING + IN_CHILD.replace("{end}", end), state, prelude=unwatched)
    uses = ("look-up", "new", "explicit", "remote call", "started call", "local call", "register")
    for use in uses:
        assert program.heard() == f"{use} refused"
    assert program.heard() == "child 0"
    if state == "open":
        assert program.heard() == "parent 0.5 0.5"
        assert program.heard() == "late True"
    assert program.ends() == 0


def test_a_child_forked_before_the_first_container_may_have_one(start_program: Any, unwatched: str) -> None:
    program = start_program(
        """
        import os
        child = os.fork()
        if child == 0:
            say(len(trade.services(where(name="clock"))))
            trade.close()
            os._exit(0)
        say("child", os.waitpid(child, 0)[1])
        """,
        prelude=unwatched,
    )
    assert [program.heard(), program.heard()] == ["1", "child 0"]


def test_a_spawned_child_is_a_program_like_any_other(here: Container) -> None:
    here.register(Lamp(), "hall")
    source = "import trade; print(trade.find(trade.where(name='brightness'), wait_s=30)())"
    ended = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.stdout.strip(), ended.stderr, ended.returncode) == ("0.5", "", 0)


def test_nothing_is_found_in_an_empty_system(system: str) -> None:
    with pytest.raises(NoSuchService):
        trade.find(where(name="anything"), wait_s=0)
