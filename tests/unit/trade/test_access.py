"""The access policy at work: refused by who calls before anything is sent, and once more by who is called."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.unit.trade.joint_with_policy import Neck, find, policy, rewritten
from trade import CallModel, Container, Estop, Handle, Settings, service, where
from trade._container.builtin_services import OwnServices
from trade._context.call_context import CallContext, running
from trade._estop.services import EstopServices
from trade._registry.suggestions import no_such_service
from trade._security.authorizer import FUNCTIONS, Authorizer
from trade._services.decorator import marked_methods
from trade.errors import AccessDenied, ConfigurationError, LockedByOther, LockLost, NoSuchService, Stopped
from trade.protocol.keys import Address, alive_key, estop_key
from trade.protocol.messages import PROTOCOL, Behalf, EstopOrder, encode_message
from trade.testing import MemorySystem
from trade.transport.memory import MemoryTransport

pytestmark = pytest.mark.virtual_time

__all__ = ["policy"]

Member = Callable[[str], Container]


@pytest.fixture
def member(memory: MemorySystem, policy: Path) -> Member:
    """Starts a container under an identity, with the policy loaded."""

    def start(identity: str) -> Container:
        container = memory.container(f"of-{identity}", identity=identity)
        if container.access.policy is None:
            container.load_policy(policy)
        memory.settle()
        return container

    return start


@pytest.fixture
def neck(member: Member, memory: MemorySystem) -> Neck:
    """What the driver offers in group ``rosie.neck``."""
    neck = Neck()
    member("drv").register(neck, "rosie.neck")
    memory.settle()
    return neck


def test_a_permitted_identity_calls_reads_and_stops(member: Member, neck: Neck) -> None:
    planner = member("planner")
    assert (find(planner, "move")(0.1), find(planner, "angle")(), find(planner, "stop")()) == (0.1, 0.5, None)


def test_a_denied_call_reports_caller_service_and_rule_and_runs_nothing(member: Member, neck: Neck) -> None:
    dash = member("dash")
    with pytest.raises(AccessDenied) as denied:
        find(dash, "move")(0.1)
    error = denied.value
    assert (error.who, error.verb, error.what) == ("dash", "call", "rosie.neck.move")
    assert error.rule == "no rule of role viewer allows call in rosie.neck"
    assert isinstance(error, PermissionError)
    assert find(dash, "angle")() == 0.5
    assert neck.moved == []


def test_a_handle_shows_the_verb_and_the_roles_that_its_service_requires(member: Member, neck: Neck) -> None:
    dash = member("dash")
    asked = {name: (find(dash, name).verb, find(dash, name).roles) for name in ("move", "angle", "stop")}
    assert asked == {"move": ("call", ("operator",)), "angle": ("read", ("operator", "viewer")), "stop": ("", ())}
    clear = find(dash, "estop_clear", "trade")
    assert (clear.verb, clear.roles) == ("administer", ("chief",))


def test_S09_containers_that_may_offer_nothing_keep_no_estop_from_being_complete(
    memory: MemorySystem, policy: Path, member: Member, neck: Neck, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    """One sign of life, of an identity without a role, had every e-stop and each clearing end as incomplete."""
    chief, driver = member("chief"), memory.container("of-drv", identity="drv")
    raw = MemoryTransport(memory.network, "raw")
    _signs = [raw.appear(alive_key(Address("stranger", f"x{number}", "e"))) for number in range(3 * 64)]
    assert eventually(lambda: len(chief.addresses()) > 60)
    report = chief.estop(limit_s=30)
    assert report.complete, report
    assert set(report.without_services) < {f"stranger/x{number}" for number in range(3 * 64)}
    assert len(report.without_services) == 64
    assert len(driver.addresses()) < 2 * 64
    assert chief.estop_clear([report.id], limit_s=30).complete
    around = chief.reachability(limit_s=0)  # this is what `trade estop --clear` waits for
    assert around.complete, around
    assert not [name for name in around.others if name.startswith("stranger/")]


def test_S09_a_container_that_may_offer_nothing_is_no_answer(
    memory: MemorySystem, member: Member, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    """Alone, it does not mean that no e-stop is open."""
    chief = member("chief")
    raw = MemoryTransport(memory.network, "raw")
    _sign = raw.appear(alive_key(Address("stranger", "x", "e")))
    assert eventually(lambda: any(address.identity == "stranger" for address in chief.addresses()))
    assert not chief.reachability(limit_s=0).complete


def test_S09_a_container_that_may_offer_and_says_nothing_is_missing(
    memory: MemorySystem, member: Member, neck: Neck, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    chief = member("chief")
    raw = MemoryTransport(memory.network, "raw")
    _sign = raw.appear(alive_key(Address("drv", "x", "e")))
    assert eventually(lambda: any(address.container == "x" for address in chief.addresses()))
    report = chief.estop(limit_s=0.5)
    assert report.missing == ("drv/x",)
    assert not report.complete
    around = chief.reachability(limit_s=0)
    assert around.silent == ("drv/x",)
    assert not around.complete


def test_without_a_policy_a_service_asks_for_no_role(memory: MemorySystem) -> None:
    [move, *_] = memory.container("open").register(Neck(), "rosie.neck")
    assert (move.verb, move.roles) == ("call", ())


def test_S07_a_stop_needs_no_role_but_an_identity_that_is_not_revoked(member: Member, neck: Neck) -> None:
    find(member("stranger"), "stop")()
    assert neck.stops == 1
    with pytest.raises(AccessDenied, match="thief is revoked"):
        find(member("thief"), "stop")()
    assert neck.stops == 1


def test_a_denied_call_sends_nothing(member: Member, neck: Neck, monkeypatch: pytest.MonkeyPatch) -> None:
    dash = member("dash")
    move = find(dash, "move")
    monkeypatch.setattr(dash._parts.caller, "ask", lambda *_: pytest.fail("it was sent"))
    with pytest.raises(AccessDenied):
        move(0.1)


def test_calls_to_own_services_follow_the_same_rules(member: Member, neck: Neck) -> None:
    drv = member("drv")
    with pytest.raises(AccessDenied, match=r"drv may not call rosie.neck.move"):
        find(drv, "move")(0.1)


def test_registering_needs_the_right_over_every_group(member: Member) -> None:
    drv = member("drv")
    with pytest.raises(AccessDenied, match=r"drv may not register Neck in office"):
        drv.register(Neck(), ("rosie.arm", "office"))
    with pytest.raises(AccessDenied, match=r"drv may not register Neck in _"):
        drv.register(Neck())
    arm = Neck("rosie.arm")
    drv.register(arm, ("rosie.arm", "lab"))
    with pytest.raises(AccessDenied, match=r"drv may not register Neck in office"):
        drv.add_group(arm, "office")


def test_locking_needs_the_right_over_the_group(member: Member, neck: Neck) -> None:
    planner, dash = member("planner"), member("dash")
    with planner.lock(where(group="rosie.neck")):
        assert find(planner, "move")(0.1) == 0.1
    with pytest.raises(AccessDenied, match=r"dash may not lock rosie.neck \(of it rosie.neck.move\)"):
        dash.lock(where(group="rosie.neck")).acquire()


def test_a_lookup_without_read_permission_names_the_missing_permission(policy: Path) -> None:
    access = Authorizer(policy, certified=True)
    hidden = access.hidden("stranger", "rosie.neck")
    assert hidden.startswith("stranger may not read rosie.neck: ")
    assert access.hidden("planner", "rosie.neck") == ""
    assert Authorizer(policy).hidden("stranger", "rosie.neck") == ""  # without certificates nothing is hidden
    assert hidden in str(no_such_service(where(group="rosie.neck"), [], 0.1, hidden=hidden))


def test_a_look_up_says_that_the_policy_hides_it(member: Member, neck: Neck, monkeypatch: pytest.MonkeyPatch) -> None:
    dash = member("dash")
    monkeypatch.setattr(dash.access, "_certified", True)
    with pytest.raises(NoSuchService, match=r"dash may not read cellar: .*such services are hidden here"):
        dash.find(where(group="cellar", name="light"), wait_s=0)


def test_breaking_a_lock_resuming_and_clearing_need_the_right_to_administer(
    member: Member, memory: MemorySystem, neck: Neck
) -> None:
    planner, dash, chief = member("planner"), member("dash"), member("chief")
    with planner.lock(where(group="rosie.neck")):
        with pytest.raises(AccessDenied, match=r"dash may not administer rosie.neck \(of it rosie.neck.move\)"):
            dash.break_lock(where(group="rosie.neck"), "mine")
        find(dash, "stop")()
        planner.resume(where(group="rosie.neck"))
    assert len(planner.locks()) == 0
    with pytest.raises(AccessDenied, match=r"planner may not administer rosie.neck.pan"):
        planner.resume(where(group="rosie.neck"))
    chief.resume(where(group="rosie.neck"))
    report = dash.estop("smoke")
    memory.settle()
    with pytest.raises(AccessDenied, match="dash may not administer e-stop"):
        dash.estop_clear([report.id])
    assert chief.estop_clear([report.id]).complete


def test_changing_the_system_needs_the_right_to_administer(member: Member, policy: Path) -> None:
    planner, chief, drv = member("planner"), member("chief"), member("drv")
    load = where(name="load_policy", container=drv.name)
    with pytest.raises(AccessDenied, match=r"planner may not administer trade.load_policy"):
        planner.call(load, str(policy))
    chief.call(load, str(policy))
    assert planner.call(where(name="clock", container=drv.name)) > 0


STATES = ("network", "stream_listeners", "state_events", "call_profile")


def test_states_are_for_those_who_may_read_the_system_and_watching_calls_for_those_who_may_instrument(
    member: Member, memory: MemorySystem, policy: Path
) -> None:
    rewritten(policy, 'read = ["rosie"]', 'read = ["*"]')
    dash, drv = member("dash"), member("drv")
    for name in STATES:
        dash.call(where(name=name, group="trade", container=drv.name))
        with pytest.raises(AccessDenied, match=rf"drv may not read trade.{name}"):
            drv.call(where(name=name, group="trade", container=dash.name))
    watch = where(name="watch_calls", group="trade", container=drv.name)
    careless = memory.container("careless", identity="dash")  # it checks no rule before it calls
    memory.settle()
    for asking in (dash, careless):
        with pytest.raises(AccessDenied, match=r"dash may not instrument trade.watch_calls"):
            asking.call(watch, CallModel(1, {}))
    assert drv._parts.spans.watch is None


def test_every_function_of_the_middleware_is_in_the_table_of_what_they_need() -> None:
    assert set(FUNCTIONS) == {*marked_methods(OwnServices, ()), *marked_methods(EstopServices, ())}


@pytest.fixture
def careless(memory: MemorySystem, neck: Neck) -> Container:
    """A container of ``dash`` that has no policy, and so checks no rule before it calls."""
    container = memory.container("careless", identity="dash")
    memory.settle()
    return container


def test_a_provider_refuses_a_caller_that_bypasses_the_policy(careless: Container, neck: Neck) -> None:
    with pytest.raises(AccessDenied) as denied:
        find(careless, "move")(0.1)
    assert (denied.value.who, denied.value.verb, denied.value.what) == ("dash", "call", "rosie.neck.move")
    with pytest.raises(AccessDenied, match="dash may not call"):
        find(careless, "move").start(0.1).result(20)
    assert neck.moved == []
    assert find(careless, "angle")() == 0.5
    find(careless, "stop")()


def test_a_provider_refuses_locks_and_switches_to_a_caller_that_bypasses_the_policy(
    careless: Container, policy: Path
) -> None:
    with (
        pytest.raises(AccessDenied, match=r"dash may not lock rosie.neck.pan"),
        careless.lock(where(group="rosie.neck")),
    ):
        pass
    with pytest.raises(AccessDenied, match=r"dash may not administer rosie.neck.pan"):
        careless.resume(where(group="rosie.neck"))
    for name, argument in (("load_policy", str(policy)), ("connect", "tcp/127.0.0.1:1"), ("set_discovery", True)):
        with pytest.raises(AccessDenied, match=f"dash may not administer trade.{name}"):
            careless.call(where(name=name, container="of-drv"), argument)


def test_a_lock_is_not_broken_by_a_caller_that_bypasses_the_policy(careless: Container, member: Member) -> None:
    planner = member("planner")
    with planner.lock(where(group="rosie.neck")):
        with pytest.raises(AccessDenied, match=r"dash may not administer rosie.neck.pan"):
            careless.break_lock(where(group="rosie.neck"), "mine")
        assert find(planner, "move")(0.1) == 0.1


def test_a_claim_to_act_for_the_owner_of_a_lock_resumes_nothing(
    careless: Container, member: Member, neck: Neck
) -> None:
    """Whom a call is made for is what its caller says; who makes it, the transport pins."""
    planner, chief = member("planner"), member("chief")
    with planner.lock(where(group="rosie.neck")):
        find(chief, "stop")()
        for claimed in (planner.session, f"{planner.session}/page.1"):
            with pytest.raises(LockedByOther):
                call_for(careless, claimed, find(careless, "resume", "trade"), ["rosie.neck.pan"])
            with pytest.raises(Stopped):
                find(planner, "move")(0.1)
        call_for(planner, "planner/another/e1", find(planner, "resume", "trade"), ["rosie.neck.pan"])
        assert find(planner, "move")(0.1) == 0.1


def call_for(container: Container, session: str, handle: Handle, *args: object) -> Any:
    """Call, and say that it is done for that session."""
    outer = CallContext(1, "rosie.plan", "planner", container.session, None, behalf=Behalf((session,)))
    token = running.set(outer)
    try:
        return handle(*args)
    finally:
        running.reset(token)


def test_an_e_stop_is_not_cleared_without_the_right(careless: Container, member: Member, memory: MemorySystem) -> None:
    report = careless.estop("smoke")
    memory.settle()
    assert not careless.estop_clear([report.id], limit_s=0.3).complete
    assert [known.id for known in member("drv").estops()] == [report.id]


def test_a_revoked_identity_cannot_stop_a_robot(memory: MemorySystem, member: Member, neck: Neck) -> None:
    thief = memory.container("careless", identity="thief")
    memory.settle()
    thief.estop("now", limit_s=0.3)
    with pytest.raises(AccessDenied, match="thief is revoked"):
        find(thief, "stop")()
    assert (neck.stops, member("drv").estops()) == (0, [])


def test_a_revoked_identity_cannot_send_an_estop_in_another_protocol_version(
    memory: MemorySystem, member: Member, neck: Neck
) -> None:
    drv, raw = member("drv"), MemoryTransport(memory.network, "raw")
    for who in ("thief", "dash"):
        order = encode_message(EstopOrder(PROTOCOL + 1, f"of-{who}", Estop(f"of-{who}", f"{who}/raw/e1", "", 0.0)))
        raw.publish(estop_key(who)).put(order)
    memory.settle()
    memory.drive(lambda: neck.stops > 0)
    assert [known.id for known in drv.estops()] == ["of-dash"]


def test_readers_ignore_services_that_their_container_may_not_offer(
    memory: MemorySystem, member: Member, neck: Neck
) -> None:
    planner, careless = member("planner"), memory.container("careless", identity="dash")
    careless.register(Neck("mine"), "rosie.neck")
    careless.register(Neck("other"), ("office", "rosie.neck"))
    memory.settle()
    assert [handle.container for handle in planner.services(where(group="rosie.neck", name="move"))] == ["of-drv"]
    assert planner.services(where(group="office")) == []
    assert planner.services(where(name="clock", container="careless"))


def test_any_container_may_offer_only_built_in_functions_in_the_middleware_group(member: Member) -> None:
    access = member("planner").access
    assert access.may_offer("dash", "trade", "system", ("trade",))
    assert access.may_offer("dash", "trade", "estops", ("trade",))
    assert not access.may_offer("dash", "trade", "system", ("trade", "rosie"))
    assert access.may_offer("dash", "trade", "supervisor", ("trade",))
    assert not access.may_offer("dash", "trade", "another", ("trade",))
    assert not access.may_offer("thief", "trade", "system", ("trade",))


def test_a_reloaded_policy_counts_for_the_next_call_on_both_sides(
    member: Member, careless: Container, policy: Path
) -> None:
    planner, drv = member("planner"), member("drv")
    move, unchecked = find(planner, "move"), find(careless, "move")
    assert move(0.1) == 0.1
    rewritten(policy, 'dash = ["viewer"]', 'dash = ["operator"]')
    rewritten(policy, 'planner = ["operator"]', 'planner = ["viewer"]')
    drv.load_policy(policy)
    with pytest.raises(AccessDenied):  # says the provider
        move(0.1)
    planner.load_policy(policy)
    with pytest.raises(AccessDenied):  # says its own container
        move(0.1)
    assert unchecked(0.2) == 0.2


def test_a_running_call_continues_when_its_permission_is_revoked(
    member: Member, memory: MemorySystem, gate: Any, policy: Path
) -> None:
    drv, planner = member("drv"), member("planner")
    drv.register(gate, "rosie.neck.gate")
    memory.settle()
    run = find(planner, "pass_through").start()
    assert gate.entered.wait(20)
    drv.load_policy(rewritten(policy, 'planner = ["operator"]', "planner = []"))
    gate.open.set()
    assert run.result(20) == "through"


def test_an_invalid_policy_says_why_and_leaves_the_old_one(member: Member, neck: Neck, policy: Path) -> None:
    planner, chief = member("planner"), member("chief")
    old = policy.read_text()
    policy.write_text("[roles]\nidentities = 1\n")
    with pytest.raises(ConfigurationError, match=r"roles.identities: must be a table"):
        planner.load_policy(policy)
    with pytest.raises(ConfigurationError, match=r"roles.identities: must be a table"):
        chief.call(where(name="load_policy", container="of-drv"), str(policy))
    assert find(planner, "move")(0.1) == 0.1
    policy.write_text(old)
    chief.system.load_policy(str(policy))


def test_what_may_no_longer_be_offered_leaves_and_returns_with_the_right(
    member: Member, memory: MemorySystem, neck: Neck, policy: Path, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    planner = member("planner")
    joined, left = list[str](), list[str]()
    planner.joined(where(name="move"), lambda handle: joined.append(handle.label))
    planner.left(where(name="move"), lambda handle: left.append(handle.label))
    planner.load_policy(rewritten(policy, 'drv = ["driver"]', "drv = []"))
    memory.settle()
    assert planner.services(where(name="move")) == []
    assert eventually(lambda: left == ["rosie.neck.move"])
    planner.load_policy(rewritten(policy, "drv = []", 'drv = ["driver"]'))
    assert eventually(lambda: joined == ["rosie.neck.move"])
    assert find(planner, "move")(0.1) == 0.1


def test_a_lock_that_may_no_longer_be_held_is_lost(member: Member, neck: Neck, policy: Path) -> None:
    planner, drv = member("planner"), member("drv")
    with pytest.raises(LockLost, match="planner may not lock"), planner.lock(where(group="rosie.neck")):
        drv.load_policy(rewritten(policy, 'lock = ["rosie.neck"]', ""))
        assert drv.locks() == []
        with pytest.raises(LockLost, match="planner may not lock"):
            find(planner, "move")(0.1)


def test_a_waiting_client_gets_no_lock_that_it_may_no_longer_hold(
    member: Member, memory: MemorySystem, neck: Neck, policy: Path, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    drv, chief = member("drv"), memory.container("unchecked", identity="chief")
    rewritten(policy, 'chief = ["chief"]', 'chief = ["chief", "operator"]')
    drv.load_policy(policy)
    other = memory.container("careless", identity="planner")
    memory.settle()
    refused = list[Exception]()

    def wait() -> None:
        try:
            other.lock(where(group="rosie.neck"), wait_s=20).acquire()
        except AccessDenied as denied:
            refused.append(denied)

    with chief.lock(where(group="rosie.neck")):
        waiting = threading.Thread(target=wait)
        waiting.start()
        assert eventually(lambda: any(info.waiting for info in drv.locks()))
        drv.load_policy(rewritten(policy, 'planner = ["operator"]', 'planner = ["viewer"]'))
        assert [info.holder.identity for info in drv.locks()] == ["chief"]
    waiting.join(20)
    assert [str(denied).split(":")[0] for denied in refused] == ["planner may not lock rosie.neck.pan"]
    assert drv.locks() == []


class Waver:
    def __init__(self, home: Container) -> None:
        self._home = home

    @service
    def wave(self) -> float:
        return find(self._home, "move")(0.3)


def test_a_nested_call_is_made_and_judged_as_the_container_that_makes_it(
    member: Member, memory: MemorySystem, neck: Neck, policy: Path
) -> None:
    rewritten(policy, 'drv = ["driver"]', 'drv = ["driver"]\nwaver = ["operator", "driver"]')
    rewritten(policy, 'read = ["rosie"]', 'read = ["rosie"]\ncall = ["lab"]')
    waver, dash = member("waver"), member("dash")
    member("drv").load_policy(policy)
    waver.register(Waver(waver), "lab")
    memory.settle()
    assert dash.call(where(name="wave")) == 0.3
    with pytest.raises(AccessDenied):
        find(dash, "move")(0.3)


def test_a_caller_and_a_service_are_decided_about_once(
    member: Member, careless: Container, neck: Neck, policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drv = member("drv")
    decided = list[str]()
    judge = drv.access.denied_call

    def counted(*asked: Any) -> AccessDenied | None:
        decided.append(asked[3])
        return judge(*asked)

    monkeypatch.setattr(drv.access, "denied_call", counted)
    angle = find(careless, "angle")
    for _ in range(20):
        angle()
    assert decided.count("angle") == 1
    drv.load_policy(policy)
    angle()
    assert decided.count("angle") == 2


def test_a_caller_asks_its_policy_once_a_service(
    member: Member, neck: Neck, policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = member("planner")
    asked = list[str]()
    require = planner.access.require_call

    def counted(*words: str) -> None:
        asked.append(words[2])
        require(*words)

    monkeypatch.setattr(planner.access, "require_call", counted)
    move = find(planner, "move")
    for _ in range(20):
        move(0.1)
    assert asked.count("move") == 1


def test_a_policy_is_named_in_the_environment_and_read_at_the_start(policy: Path, tmp_path: Path) -> None:
    settings = Settings.read(environment={"TRADE_POLICY": str(policy)})
    assert settings.policy == policy
    assert Settings.read(environment={}).policy is None
    missing = Settings.read(environment={"TRADE_POLICY": str(tmp_path / "none.toml")})
    with pytest.raises(ConfigurationError, match="cannot be read"):
        Container(missing)
