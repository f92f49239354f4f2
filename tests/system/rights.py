"""What each identity may do, found out by trying it at each place where that is decided; as a table for the docs.

Its own container and the provider are asked in one process, with nothing else in between; the gateway by bare
sessions on a real network.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from tests.system.attack import ARM, Attack
from trade import Container, Resource, service, where
from trade.errors import AccessDenied
from trade.protocol.messages import Call
from trade.testing import MemorySystem, memory_system

WHO: Final = {
    "operator": "planner",
    "viewer": "dash",
    "driver": "arm",
    "chief": "chief",
    "no role": "idle",
    "not named": "mallory",
    "revoked": "thief",
}
"""By the heading of a column, an identity of that kind."""
_WITHOUT_RULES: Final = ("mallory", "thief")
_MARKS: Final = (
    "<!-- rights: made by test_the_table_of_rights_matches_the_behaviour -->\n",
    "<!-- end of rights -->\n",
)


class Joint:
    def __init__(self) -> None:
        self.resources = (Resource("joint"),)

    @service
    def move(self) -> None: ...

    @service(effect="read")
    def angle(self) -> float:
        return 0.5

    @service(effect="stop")
    def halt(self) -> None: ...


class Stage:
    """A provider, the client that tries, and those that undo the consequences."""

    def __init__(self, memory: MemorySystem, policy: Path) -> None:
        self.memory = memory
        self.policy = policy
        self.arm, self.planner, self.chief = (self.container(who, who) for who in ("arm", "planner", "chief"))
        self.arm.register(Joint(), ARM)
        memory.settle()

    def container(self, name: str, identity: str, *, honest: bool = True) -> Container:
        made = self.memory.container(name, identity=identity)
        if honest and made.access.policy is None:
            made.load_policy(self.policy)
        elif not honest:
            made.access.policy = None
        self.memory.settle()
        return made

    def call(self, actor: Container, name: str, group: str = ARM, *arguments: object) -> bool:
        actor.call(where(name=name, group=group, container="arm"), *arguments)
        return True

    def register(self, actor: Container) -> bool:
        offered = Joint()
        actor.register(offered, "rosie.leg")
        self.memory.settle()
        seen = bool(self.chief.services(where(group="rosie.leg")))
        actor.deregister(offered)
        return seen

    def lock(self, actor: Container) -> bool:
        with actor.lock(where(group=ARM), wait_s=0):
            return True

    def break_lock(self, actor: Container) -> bool:
        lock = self.planner.lock(where(group=ARM)).acquire()
        try:
            return bool(actor.break_lock(where(group=ARM), "it is needed"))
        finally:
            lock.release()

    def estop(self, actor: Container) -> bool:
        given = actor.estop("a test", limit_s=1.0).id
        self.memory.settle()
        heeded = given in [known.id for known in self.arm.estops()]
        self.all_clear()
        return heeded

    def estop_clear(self, actor: Container) -> bool:
        given = self.chief.estop("a test").id
        self.memory.settle()
        try:
            actor.estop_clear([given], limit_s=1.0)
            self.memory.settle()
            return not self.arm.estops()
        finally:
            self.all_clear()

    def watch(self, actor: Container) -> bool:
        moved, looked = (actor.find(where(name=name, group=ARM, container="arm")) for name in ("move", "angle"))
        actor.after_service(moved, looked).detach()
        return True

    def notify(self, actor: Container) -> bool:
        actor.after(60, actor.find(where(name="angle", group=ARM, container="arm")), host="planner").cancel()
        return True

    def all_clear(self) -> None:
        if open_ := [known.id for known in self.chief.estops()]:
            self.chief.estop_clear(open_)
        self.memory.settle()
        self.chief.resume(where(group=ARM))


class Action(NamedTuple):
    """Something that one may do, or not."""

    verb: str
    attempt: Callable[[Stage, Container], bool]
    """Whether it came to pass; raises AccessDenied."""
    key: Callable[[Attack, str, str], str]
    """What a session puts for it, of which name and identity."""


def _service(attack: Attack, _: str, who: str) -> str:
    return attack.key(who)


def _middleware(attack: Attack, _: str, who: str) -> str:
    return attack.key(who, system=True)


def _estop(attack: Attack, _: str, who: str) -> str:
    return f"estop/{who}"


ACTIONS: Final[Mapping[str, Action]] = {
    "call what reads": Action("read", lambda s, c: s.call(c, "angle"), _service),
    "call what actuates": Action("call", lambda s, c: s.call(c, "move"), _service),
    "offer a provider": Action("register", Stage.register, lambda _, name, who: f"registry/{ARM}/{who}/{name}/e1/P"),
    "lock": Action("lock", Stage.lock, _middleware),
    "take a lock away": Action("administer", Stage.break_lock, _middleware),
    "watch a service with a hook": Action("instrument", Stage.watch, _middleware),
    "have another container notify": Action("instrument", Stage.notify, _middleware),
    "load a policy": Action("administer", lambda s, c: s.call(c, "load_policy", "trade", str(s.policy)), _middleware),
    "clear an e-stop": Action("administer", Stage.estop_clear, _estop),
    "call a stop": Action("", lambda s, c: s.call(c, "halt"), lambda a, _, who: a.key(who, kind="stop")),
    "e-stop": Action("", Stage.estop, _estop),
    "ask for the clock": Action("", lambda s, c: s.call(c, "clock", "trade"), _middleware),
}


def found_out(attack: Attack) -> str:
    """The table, in Markdown, of what happens now."""
    crossed = {who: _crossed(attack, who) for who in WHO.values()}
    with _stage(attack.site.policy) as stage:
        rows = [
            [f"{what} (`{act.verb}`)" if act.verb else what]
            + [_cell(stage, act, who, what in crossed[who]) for who in WHO.values()]
            for what, act in ACTIONS.items()
        ]
    head = ["", *WHO]
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


@contextmanager
def _stage(policy: Path) -> Iterator[Stage]:
    with memory_system() as memory:
        yield Stage(memory, policy)


def _cell(stage: Stage, action: Action, who: str, crosses: bool) -> str:
    refused = [
        letter
        for letter, refuses in (
            ("C", not _tried(stage, action, who, honest=True)),
            ("G", not crosses),
            ("P", not _tried(stage, action, who, honest=False)),
        )
        if refuses
    ]
    return " ".join(refused) or "yes"


def _tried(stage: Stage, action: Action, who: str, *, honest: bool) -> bool:
    """Whether it comes to pass; of an honest container, whether it lets it out."""
    actor = stage.container(f"{'honest' if honest else 'careless'}-{who}", who, honest=honest)
    try:
        with _recorded_calls(actor) as sent:
            return action.attempt(stage, actor) or honest
    except AccessDenied:
        stage.memory.settle()
        return honest and bool(sent)
    finally:
        actor.close()
        stage.memory.settle()


@contextmanager
def _recorded_calls(actor: Container) -> Iterator[list[str]]:
    """Names of the services that its calls go out to."""
    sent: list[str] = []
    caller: Any = actor._parts.caller
    ask, start = caller.ask, caller.start

    def noted(send: Callable[..., Any], call: Call, *reported: Any) -> Any:
        sent.append(call.service)
        return send(call, *reported)

    caller.ask, caller.start = partial(noted, ask), partial(noted, start)
    yield sent


def _crossed(attack: Attack, who: str) -> set[str]:
    """What of an identity the gateway passes on."""
    name = attack.open(who)
    keys = {what: action.key(attack, name, who) for what, action in ACTIONS.items()}
    said = list(keys.values())
    passed = attack.slipped(name, *said) if who in _WITHOUT_RULES else attack.passed(name, who, *said)
    attack.intruder.ask("close", name)
    return {what for what, key in keys.items() if key in passed}


def in_the_page(page: str) -> str:
    """The table of a page."""
    return page.partition(_MARKS[0])[2].partition(_MARKS[1])[0]


def written_into(page: str, table: str) -> str:
    before, mark, rest = page.partition(_MARKS[0])
    return before + mark + table + _MARKS[1] + rest.partition(_MARKS[1])[2]
