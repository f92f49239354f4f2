"""Attacks on a gateway from the public side, each beside the same action of the right identity, which succeeds.

The driver ``arm`` is on the private network; ``planner`` and ``chief`` on the public one may use and administer it. On
a second public host are ``dash``, which may read, and goes by a policy of its own in which it may do everything, and
an intruder: bare sessions with whatever certificate.
"""

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.system import rights
from tests.system.attack import ARM, POLICY, Attack, numbers
from tests.system.conftest import ROOT, networks_of_ones_own
from tests.system.sites import GATEWAY, Site
from trade._security.authorizer import FUNCTIONS
from trade.protocol.messages import (
    EMPTY,
    PROTOCOL,
    Behalf,
    ProviderInfo,
    Reply,
    ServiceInfo,
    Status,
    Tally,
    Token,
    encode_message,
)

pytestmark = [pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def attack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Attack]:
    with networks_of_ones_own() as networks:
        site = Site(networks, tmp_path_factory.mktemp("site"), POLICY, '["lab", "rosie"]', '["rosie"]')
        try:
            yield Attack(site)
        finally:
            site.close()


def own_session(attack: Attack, identity: str, mode: str = "peer") -> Iterator[str]:
    name = attack.open(identity, mode)
    yield name
    attack.intruder.ask("close", name)


@pytest.fixture(scope="module")
def as_dash(attack: Attack) -> Iterator[str]:
    yield from own_session(attack, "dash")


@pytest.fixture(scope="module")
def as_planner(attack: Attack) -> Iterator[str]:
    yield from own_session(attack, "planner")


@pytest.fixture(scope="module")
def as_arm(attack: Attack) -> Iterator[str]:
    """A client that has the driver's key is the driver, wherever it is."""
    yield from own_session(attack, "arm")


def test_a_read_only_client_neither_moves_nor_locks(attack: Attack) -> None:
    before = attack.moved()
    for words in (("move", ARM, "1"), ("lock", ARM), ("hold", ARM)):
        assert attack.dash.refused(*words).startswith("AccessDenied: dash may not")
    assert attack.dash.ask("call_group", ARM) == [7]
    assert attack.moved() == before
    attack.planner.ask("move", ARM, "1")
    attack.planner.ask("lock", ARM)
    assert attack.moved() == [*before, 0, 1]


def test_a_read_only_client_breaks_no_lock_and_resumes_nothing(attack: Attack) -> None:
    planner = attack.planner
    planner.ask("hold", ARM)
    assert attack.dash.refused("break_lock", ARM).startswith("AccessDenied: dash may not administer")
    assert planner.ask("still_held")
    attack.chief.ask("call", "halt", ARM, "arm")
    assert attack.dash.refused("resume", ARM).startswith("LockedByOther")
    planner.ask("started", "move", ARM, "5")
    assert planner.refused("ended").startswith("Stopped")
    planner.ask("resume", ARM)
    planner.ask("started", "move", ARM, "6")
    planner.ask("ended")
    attack.chief.ask("break_lock", ARM)
    wait_until(lambda: not planner.ask("still_held"), "its owner is notified")
    planner.ask("unlock")
    attack.chief.ask("call", "halt", ARM, "arm")
    assert attack.dash.refused("resume", ARM).startswith("AccessDenied")
    attack.chief.ask("resume", ARM)
    assert attack.moved()[-1] == 6


def test_a_client_that_may_not_administer_changes_nothing_of_others(attack: Attack) -> None:
    for name in (function for function, verb in FUNCTIONS.items() if verb == "administer"):
        denied = attack.dash.refused("call", name, "trade", "arm")
        assert denied.startswith(f"AccessDenied: dash may not administer trade.{name}")
        many = ["null"] * 9  # else it would do it
        assert attack.chief.refused("call", name, "trade", "arm", *many).startswith("InvalidArgument")
    policy = json.dumps(str(attack.site.folder / "arm.toml"))
    for name, argument in (("load_policy", policy), ("set_broadcast", "false"), ("set_discovery", "false")):
        assert attack.dash.refused("call", name, "trade", "arm", argument).startswith("AccessDenied")
        attack.chief.ask("call", name, "trade", "arm", argument)


def test_any_client_can_estop_and_an_unauthorized_one_cannot_clear_it(attack: Attack) -> None:
    stopped = attack.dash.ask("estop")
    attack.dash.ask("estop_clear", stopped)
    assert attack.arm.ask("estops") == [stopped]
    assert attack.planner.refused("move", ARM, "1").startswith("Stopped")
    wait_until(lambda: attack.chief.ask("estops") == [stopped], "all containers know of it")
    assert attack.chief.ask("estop_clear", stopped)
    attack.chief.ask("resume", ARM)
    attack.planner.ask("move", ARM, "1")


def test_services_of_a_container_without_the_right_to_offer_are_invisible(attack: Attack) -> None:
    attack.dash.ask("register_one", "rosie.leg")
    attack.dash.ask("register_one", "lab.dash")
    for reader in (attack.arm, attack.planner):
        assert [label for _, label in reader.ask("group", "lab.dash", "dash")] == ["lab.dash.echo"]
        assert reader.ask("seen", "rosie.leg") == []
    attack.dash.ask("deregister_one", "lab.dash")
    attack.arm.ask("register_one", "rosie.leg")
    assert [label for _, label in attack.planner.ask("group", "rosie.leg", "arm")] == ["rosie.leg.echo"]
    attack.arm.ask("deregister_one", "rosie.leg")


def test_a_notification_does_nothing_that_its_owner_has_no_right_to(attack: Attack) -> None:
    for member in (attack.dash, attack.planner):
        member.ask("greet_joining", "lab.planner.bell", ARM)
    attack.planner.ask("register_one", "lab.planner.bell")
    wait_until(lambda: attack.arm.ask("greeted", ARM), "the right one is heeded")
    attack.dash.ask("group", "lab.planner.bell", "planner")
    attack.dash.refused("move", ARM, "1")  # by now its word has been said, too
    assert attack.arm.ask("greeted", ARM) == ["planner lab.planner.bell.echo"]


def test_a_hook_is_attached_only_with_the_right_to_instrument(attack: Attack) -> None:
    denied = attack.dash.refused("watch_moves", ARM, "lab.dash.eye")
    assert denied.startswith("AccessDenied: dash may not instrument rosie.arm.move")
    attack.chief.ask("watch_moves", ARM, "lab.chief.eye")
    attack.planner.ask("move", ARM, "3")
    assert attack.chief.ask("seen_moving") == [{"number": number} for number in range(3)]
    attack.chief.ask("watch_no_more")


def test_a_notification_elsewhere_has_the_rights_of_its_owner(attack: Attack) -> None:
    """The container that makes the call has the right to; that does not help who asked."""
    denied = attack.dash.refused("once_at", "planner", "move", ARM, "4")
    assert denied.startswith("AccessDenied: dash may not instrument trade.notify")
    before = attack.moved()
    assert attack.chief.ask("once_at", "planner", "move", ARM, "4").startswith("AccessDenied: chief may not call")
    assert attack.moved() == before
    assert attack.chief.ask("once_at", "planner", "echo", ARM, "4") == "done"


def test_a_nested_call_has_the_rights_of_its_container_and_not_of_the_first_caller(attack: Attack) -> None:
    attack.dash.ask("register_relay", "lab.dash.relay", ARM)
    attack.planner.ask("register_relay", "lab.planner.relay", ARM)
    before = attack.moved()
    denied = attack.planner.refused("call", "relay", "lab.dash.relay", "dash", "1")
    assert denied.startswith("AccessDenied: dash may not call")
    assert attack.moved() == before
    attack.dash.ask("call", "relay", "lab.planner.relay", "planner", "2")
    assert attack.moved() == [*before, 2]


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_a_key_in_the_name_of_another_identity_is_passed_on_nowhere(attack: Attack, as_planner: str, mode: str) -> None:
    before = attack.moved()
    dash = attack.open("dash", mode)
    for forged in ("planner", "*", "arm", "door"):
        assert attack.passed(dash, "dash", attack.key(forged), payload=attack.call(dash, forged, "move", 1)) == []
    for forged in ("chief", "door"):
        load = attack.call(dash, forged, "load_policy", str(attack.site.folder / "lenient.toml"))
        assert attack.passed(dash, "dash", attack.key(forged, system=True), payload=load) == []
    assert attack.passed(dash, "dash", attack.key("planner", kind="stop"), "estop/planner", "estop/door") == []
    assert attack.moved() == before
    right = attack.call(as_planner, "planner", "move", 2)
    assert attack.passed(as_planner, "planner", attack.key("planner"), payload=right) == [attack.key("planner")]
    wait_until(lambda: attack.moved() == [*before, 2], "the right one is heeded")
    assert attack.passed(dash, "dash", attack.key("dash", kind="stop"), "estop/dash") == [
        "estop/dash",
        attack.key("dash", kind="stop"),
    ]
    attack.intruder.ask("close", dash)


def test_another_identitys_session_in_an_own_key_is_dropped(attack: Attack, as_dash: str, as_planner: str) -> None:
    before, other = attack.moved(), attack.planner.ask("session")
    clock = attack.key("dash", system=True)
    attack.say(as_dash, clock, attack.call(as_dash, "dash", "clock", session=other, channel=f"{as_dash}/forged"))
    attack.settle(as_dash, "dash")
    heard = attack.intruder.ask("heard", as_dash)
    assert not any(key.endswith("/forged") for key, _ in heard)
    attack.say(as_planner, attack.key("planner"), attack.call(as_planner, "planner", "move", 3, session=other))
    wait_until(lambda: attack.moved() == [*before, 3], "who may speak for it does")


def test_knowing_the_number_of_a_lock_does_not_allow_its_use(attack: Attack, as_planner: str) -> None:
    attack.planner.ask("hold", ARM)
    tokens = tuple(Token(*grant) for grant in attack.planner.ask("grants"))
    session = attack.planner.ask("session")
    behalf = Behalf((session,), (), tokens)
    before = attack.moved()
    porter = attack.open("porter")
    attack.say(porter, attack.key("porter"), attack.call(porter, "porter", "move", 4, behalf=behalf))
    attack.settle(porter, "porter")
    assert attack.moved() == before
    attack.chief.ask("call", "halt", ARM, "arm")
    resume = attack.call(porter, "porter", "resume", ["joint"], behalf=behalf)
    attack.say(porter, attack.key("porter", system=True), resume)
    attack.settle(porter, "porter")
    attack.planner.ask("started", "move", ARM, "5")
    assert attack.planner.refused("ended").startswith("Stopped")
    resume = attack.call(as_planner, "planner", "resume", ["joint"], behalf=behalf)
    attack.say(as_planner, attack.key("planner", system=True), resume)
    attack.settle(as_planner, "planner")
    attack.say(as_planner, attack.key("planner"), attack.call(as_planner, "planner", "move", 6, behalf=behalf))
    wait_until(lambda: attack.moved() == [*before, 6], "who holds it does")
    attack.planner.ask("unlock")
    attack.intruder.ask("close", porter)


def test_an_answer_comes_only_from_the_callee_and_reaches_only_the_caller(
    attack: Attack, as_dash: str, as_arm: str
) -> None:
    """Even if the intruder knew the channel and the number of the call."""
    attack.intruder.ask("listen", as_dash, "reply/*/planner/**", f"reply/*/dash/{as_dash}/*")
    for name, who, comes in ((as_dash, "dash", False), (as_arm, "arm", True)):
        attack.planner.ask("started", "nap", ARM, "5.0" if comes else "0.5")
        channel, number = attack.planner.ask("waits")
        refused = encode_message(Reply(PROTOCOL, number, Status.BUSY, time.monotonic_ns(), EMPTY)).hex()
        for speaker in ("arm", who, "planner"):
            attack.say(name, f"reply/{speaker}/planner/{channel}", refused)
        if comes:
            assert attack.planner.refused("ended").startswith("Busy")
        else:
            assert attack.planner.ask("ended") is None
    attack.settle(as_dash, "dash")
    assert not any("/planner/" in key for key, _ in attack.intruder.ask("heard", as_dash))


def test_a_reply_cannot_be_sent_to_another_client(attack: Attack, as_dash: str) -> None:
    """The channel that a call names is one of its caller's own."""
    attack.planner.ask("started", "nap", ARM, "0.5")
    channel, _ = attack.planner.ask("waits")
    clock = attack.call(as_dash, "dash", "clock", channel=channel)
    attack.planner.ask("tap")
    attack.say(as_dash, attack.key("dash", system=True), clock)
    attack.settle(as_dash, "dash")
    assert attack.planner.ask("ended") is None
    assert {key.split("/")[2] for key in attack.planner.ask("tapped") if key.startswith("reply/")} == {"planner"}


def entry(revision: int) -> str:
    moving = ServiceInfo(name="echo", signature="echo() -> None", effect="actuate")
    made = ProviderInfo(revision=revision, groups=("rosie.trap",), kind="Trap", host="h", pid=1, services=(moving,))
    return encode_message(made).hex()


def test_a_registry_entry_counts_only_from_a_container_that_may_offer_it(
    attack: Attack, as_dash: str, as_arm: str
) -> None:
    real = "/".join(attack.place[:3])
    for owner in (real, f"dash/{as_dash}/e1"):
        attack.intruder.ask("token", as_dash, f"alive/dash/{as_dash}/e1")
        keys = [f"registry/{domain}/{owner}/Trap" for domain in ("rosie.trap", "rosie")]
        tally = [f"registry/trade/{real}/tally"] if owner == real else []
        assert attack.passed(as_dash, "dash", *keys, *tally, payload=entry(9)) == []
        attack.intruder.ask("answer", as_dash, f"registry/*/{owner}/*", keys[0], entry(9))
    assert attack.planner.ask("seen", "rosie.trap") == []
    assert attack.planner.ask("seen", ARM) == [real]
    ghost = f"arm/{as_arm}/e1"
    reported = [f"registry/rosie.trap/{ghost}/Trap", entry(1), f"registry/trade/{ghost}/tally", tally_of(1)]
    attack.intruder.ask("answer", as_arm, f"registry/*/{ghost}/*", *reported)
    attack.intruder.ask("token", as_arm, f"alive/{ghost}")
    wait_until(lambda: attack.planner.ask("seen", "rosie.trap") == [ghost], "the driver's is seen")
    assert attack.planner.ask("seen", ARM) == [real]


def tally_of(revision: int) -> str:
    return encode_message(Tally(PROTOCOL, revision)).hex()


def test_a_container_can_declare_only_its_own_liveliness(attack: Attack, as_dash: str) -> None:
    ghosts = [f"{who}/ghost/e{next(numbers)}" for who in ("planner", "arm", "door", "dash")]
    for ghost in ghosts:
        attack.intruder.ask("token", as_dash, f"alive/{ghost}")
    for reader in (attack.arm, attack.planner):
        wait_until(lambda reader=reader: ghosts[-1] in reader.ask("addresses"), "its own is seen")
        assert not set(ghosts[:-1]) & set(reader.ask("addresses"))


def test_a_private_container_with_the_name_of_a_public_one_takes_nothing_from_it(attack: Attack) -> None:
    """Containers of one name are distinguished by identity and boot; answers go by those."""
    twin = attack.site.launched("left", "planner", identity="porter")
    twin.ask("start", GATEWAY["private"])
    assert twin.ask("group", ARM, "arm") and twin.ask("call_group", ARM) == [7]
    before = attack.moved()
    attack.planner.ask("started", "nap", ARM, "1.0")
    twin.ask("move", ARM, "2")
    attack.planner.ask("move", ARM, "1")
    attack.planner.ask("ended")
    assert attack.moved() == [*before, 0, 1, 0]
    names = [address.split("/")[:2] for address in attack.chief.ask("addresses")]
    assert ["planner", "planner"] in names and ["porter", "planner"] in names
    attack.planner.ask("hold", ARM)
    assert twin.refused("move", ARM, "1").startswith("LockedByOther")
    attack.planner.ask("unlock")
    twin.close()
    attack.site.members.remove(twin)


@pytest.fixture(scope="module")
def bad_certificates(attack: Attack) -> dict[str, tuple[Path, str]]:
    """Folders that no container would start with, and the error for each."""
    folder = attack.site.folder
    strangers = Papers(folder / "elsewhere")
    expired = shutil.copytree(attack.site.papers.expired("planner"), folder / "expired")
    foreign = shutil.copytree(strangers.of("planner"), folder / "foreign")
    forged = shutil.copytree(foreign, folder / "forged")  # but that it trusts whom it attacks
    shutil.copy(attack.site.papers.of("planner") / "ca.pem", forged)
    return {"expired": (expired, "EXPIRED"), "of another system": (foreign, "CA"), "with a wrong key": (forged, "CA")}


@pytest.mark.parametrize("bad", ["expired", "of another system", "with a wrong key"])
def test_an_invalid_certificate_is_refused(
    attack: Attack, bad_certificates: dict[str, tuple[Path, str]], bad: str
) -> None:
    before = attack.moved()
    folder, alert = bad_certificates[bad]
    host, _, port = GATEWAY["public"].removeprefix("tls/").partition(":")
    assert alert in attack.intruder.ask("knock", str(folder), host, port).upper()
    assert attack.intruder.ask("knock", str(attack.site.papers.of("planner")), host, port) == ""
    name = f"bad{next(numbers)}"
    attack.intruder.ask("open", name, str(folder), GATEWAY["public"])
    attack.say(name, attack.key("planner"), attack.call(name, "planner", "move", 7))
    good = attack.open("planner")
    attack.say(name, attack.key("planner"), attack.call(name, "planner", "move", 7))
    attack.say(good, attack.key("planner"), attack.call(good, "planner", "move", 8))
    wait_until(lambda: attack.moved() == [*before, 8], "with the right one it is heeded")
    assert not attack.intruder.ask("linked_now", name)
    for session in (name, good):
        attack.intruder.ask("close", session)


def silent(attack: Attack, name: str, who: str) -> bool:
    """Whether nothing at all of it passes, neither a call nor a stop."""
    keys = [attack.key(who), attack.key(who, system=True), attack.key(who, kind="stop"), f"estop/{who}"]
    return not attack.slipped(name, *keys)


@pytest.mark.parametrize("who", ["mallory", "idle"])
def test_an_identity_without_a_role_or_unknown_can_at_most_stop(attack: Attack, as_planner: str, who: str) -> None:
    before = attack.moved()
    name = f"{who}{next(numbers)}"
    attack.intruder.ask("open", name, str(attack.site.papers.of(who)), GATEWAY["public"])
    assert attack.intruder.ask("linked", name)  # of this authority it is
    attack.say(name, attack.key(who), attack.call(name, who, "move", 1))
    assert silent(attack, name, who) == (who == "mallory")
    attack.say(as_planner, attack.key("planner"), attack.call(as_planner, "planner", "move", 2))
    wait_until(lambda: attack.moved() == [*before, 2], "the right one is heeded")
    attack.intruder.ask("close", name)


def test_an_identity_revoked_while_linked_is_silenced_and_calls_of_others_continue(attack: Attack) -> None:
    before = attack.moved()
    thief = attack.open("thief")
    attack.say(thief, attack.key("thief"), attack.call(thief, "thief", "move", 1))
    wait_until(lambda: attack.moved() == [*before, 1], "so far it may")
    attack.planner.ask("started", "nap", ARM, "4.0")
    attack.planner.ask("hold", ARM)
    attack.revoke("thief")
    wait_until(lambda: attack.intruder.ask("linked", thief), "its certificate is still good for a link")
    assert silent(attack, thief, "thief")
    attack.say(thief, attack.key("thief"), attack.call(thief, "thief", "move", 2))
    attack.planner.ask("ended")
    assert attack.planner.ask("still_held")
    attack.planner.ask("unlock")
    attack.planner.ask("move", ARM, "1")
    assert attack.moved() == [*before, 1, 0]


def test_the_table_of_rights_matches_the_behaviour(attack: Attack) -> None:
    """With WRITE_TABLES=1 in the environment it is written again."""
    attack.revoke("thief")
    page = ROOT / "docs" / "access-control.md"
    table = rights.found_out(attack)
    if os.environ.get("WRITE_TABLES"):
        page.write_text(rights.written_into(page.read_text(encoding="utf-8"), table), encoding="utf-8")
    assert rights.in_the_page(page.read_text(encoding="utf-8")) == table
