"""A provider that does not migrate continues where it is, with its state, and leaves nothing at the target."""

import threading
import time
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.moving_providers import MODULE, Scene, imported
from trade import Handle, errors, where
from trade._migration import quiesce, target
from trade._migration.factory import path_of

pytestmark = pytest.mark.virtual_time


def refused(scene: Scene, which: Handle, to: str = "new", **options: Any) -> BaseException:
    """Have it moved in vain; whatever was made there is closed, and nothing is left of it."""
    with pytest.raises(errors.TradeError) as error:
        scene.asker.migrate(which, to=to, **options)
    scene.memory.settle()
    there = [one for one in scene.asker.services() if one.container == "new" and one.groups != ("trade",)]
    assert there == []
    made = [event for event in scene.module.events if event.startswith("made")]
    wait_until(lambda: len([event for event in scene.module.events if event.startswith("close")]) == len(made))
    return error.value


def continues(scene: Scene, count: Handle) -> bool:
    """Whether the handle from before still counts on from three."""
    scene.module.before.clear()
    return count() == 4


def test_what_is_locked_stays_also_if_who_asks_has_the_lock(scene: Scene) -> None:
    count, _ = scene.counter()
    with scene.asker.lock([count], purpose="mine"):
        error = refused(scene, count)
        assert isinstance(error, errors.LockedByOther)
        assert (error.owner, error.purpose) == ("chief/asker", "mine")
    assert continues(scene, count)


def test_a_lock_on_what_reads_counts_too(scene: Scene) -> None:
    count, shown = scene.counter()
    with scene.asker.lock([shown], purpose="look"):
        assert isinstance(refused(scene, count), errors.LockedByOther)


def test_what_moves_stays_and_is_not_stopped(scene: Scene) -> None:
    wheel = scene.module.Wheel()
    turn = scene.offer(wheel)["turn"]
    turn()
    error = refused(scene, turn)
    assert isinstance(error, errors.LockedByOther)
    assert error.owner.startswith("chief/asker/")
    assert error.purpose == "a motion that has not ended"
    assert wheel.resources[0].moving


def test_a_stop_that_holds_is_not_forgotten_by_moving(scene: Scene) -> None:
    services = scene.offer(scene.module.Wheel())
    services["turn"]()
    scene.new.handle(services["stop"].key)()
    error = refused(scene, services["turn"])
    assert isinstance(error, errors.Stopped)
    assert error.by == "new"
    scene.asker.resume([services["turn"]])
    assert scene.asker.migrate(services["turn"], to="new")


def test_nothing_migrates_during_an_e_stop(scene: Scene) -> None:
    count, _ = scene.counter()
    scene.asker.estop("smoke")
    scene.memory.settle()
    error = refused(scene, count)
    assert isinstance(error, errors.Stopped)
    assert error.estop
    scene.asker.estop_clear([one.id for one in scene.asker.estops()])


def test_a_call_that_does_not_end_keeps_it(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quiesce, "CALLS_S", 0.05)
    count, shown = scene.counter()
    inside, leave = threading.Event(), threading.Event()
    scene.module.before["count"] = lambda: (inside.set(), leave.wait(30))
    run = count.start()
    assert inside.wait(30)
    error = refused(scene, shown)
    leave.set()
    assert isinstance(error, errors.LockedByOther)
    assert error.purpose == "a call or a motion that has not ended"
    assert run.result(30) == 4


def test_a_provider_does_not_move_itself_away_under_its_own_call(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quiesce, "CALLS_S", 0.05)
    count, _ = scene.counter()
    here = scene.old.handle(count.key)
    scene.module.before["count"] = lambda: scene.old.migrate(here, to="new")
    with pytest.raises(errors.LockedByOther, match="a call or a motion that has not ended"):
        count()
    assert continues(scene, count)


def test_a_lock_that_is_broken_meanwhile_ends_the_attempt(scene: Scene) -> None:
    count, _ = scene.counter()
    scene.module.before["restore"] = lambda: scene.asker.break_lock([count], "no time for that")
    error = refused(scene, count)
    assert isinstance(error, errors.LockedByOther)
    assert "no time for that" in str(error)
    assert continues(scene, count)


def test_a_stop_that_comes_meanwhile_ends_the_attempt(scene: Scene) -> None:
    wheel = scene.module.Wheel()
    services = scene.offer(wheel)
    scene.module.Wheel.restore_state = lambda _self, _state: scene.asker.handle(services["stop"].key)()
    error = refused(scene, services["turn"])
    assert isinstance(error, errors.Stopped)
    scene.asker.resume([services["turn"]])
    services["turn"]()
    assert wheel.resources[0].moving


def test_it_is_moved_by_one_at_a_time(scene: Scene) -> None:
    count, shown = scene.counter()
    heard: list[BaseException | None] = []

    def again() -> None:
        with pytest.raises(errors.LockedByOther) as error:
            scene.new.migrate(where(name="shown"), to="new")
        heard.append(error.value)

    scene.module.before["save"] = again
    scene.asker.migrate(shown, to="new")
    [error] = heard
    assert "moving it, or its state, already" in str(error)
    assert count.container == "old"


def test_hardware_is_pinned_to_its_host(scene: Scene) -> None:
    error = refused(scene, scene.offer(scene.module.Bolted())["turn"])
    assert isinstance(error, errors.ConfigurationError)
    assert "it drives wheel of this host; only a class that is relocatable can leave" in str(error)


def test_what_shares_a_resource_with_another_one_stays(scene: Scene) -> None:
    one, other = scene.module.Wheel(), scene.module.Wheel()
    other.resources = one.resources
    scene.old.register(other, "hall")
    error = refused(scene, scene.offer(one)["turn"])
    assert isinstance(error, errors.ConfigurationError)
    assert "it shares wheel with other services of this container" in str(error)


def test_S18_what_is_commanded_while_state_is_restored_is_refused(scene: Scene) -> None:
    scene.module.Wheel.restore_state = lambda wheel, _state: wheel.turn()
    services = scene.offer(scene.module.Wheel())
    error = refused(scene, services["turn"])
    assert isinstance(error, errors.CannotMigrate)
    assert "restore_state there: LockedByOther: wheel is locked by new/new" in str(error)
    with pytest.raises(errors.LockedByOther, match="restoring the state"):
        scene.asker.restore_state(services["turn"], None)


def test_S18_a_provider_that_was_given_up_may_not_command_later_either(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quiesce, "BUDGET_S", 0.05)
    leave, outcomes = threading.Event(), list[Exception]()

    def linger(wheel: Any, _state: object) -> None:
        leave.wait(30)
        try:
            wheel.turn()
        except errors.LockedByOther as error:
            outcomes.append(error)

    scene.module.Wheel.restore_state = linger
    error = refused(scene, scene.offer(scene.module.Wheel())["turn"])
    assert "restore_state has not ended" in str(error)
    leave.set()
    wait_until(lambda: outcomes)


def test_S18_a_provider_that_starts_a_motion_past_all_permits_is_closed(scene: Scene) -> None:
    def move(self: Any, _state: object) -> None:
        self.resources[0].moving = True

    scene.module.Wheel.restore_state = move
    error = refused(scene, scene.offer(scene.module.Wheel())["turn"])
    assert isinstance(error, errors.CannotMigrate)
    assert "a motion that has not ended" in str(error)
    assert scene.module.events == ["made", "close"]


@pytest.mark.parametrize("to", ["nowhere", "old", "none-*"])
def test_there_must_be_another_container_of_that_name(scene: Scene, to: str) -> None:
    count, _ = scene.counter()
    error = refused(scene, count, to=to)
    assert isinstance(error, errors.NoSuchService)
    assert continues(scene, count)


def test_only_what_the_other_container_allows_is_made_there(scene: Scene) -> None:
    count, _ = scene.counter()
    scene.memory.container("closed")
    scene.memory.settle()
    assert isinstance(refused(scene, count, to="closed"), errors.NotInstantiable)
    assert continues(scene, count)


def test_a_class_that_is_not_there_is_not_made(scene: Scene) -> None:
    count, _ = scene.counter()
    imported(scene.folder, "")
    error = refused(scene, count)
    assert isinstance(error, errors.NoSuchClass)
    assert "migrants_there has no such class" in str(error)
    assert continues(scene, count)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("state_version = 1", "state_version = 2"),
        ("def count(self) -> int:", "def count(self) -> float:"),
        ("def count(self) -> int:", "def count(self, times: int = 1) -> int:"),
        ("def restore_state(self, state) -> None:\n        now", "def take(self, state) -> None:\n        now"),
    ],
)
def test_a_class_that_is_another_version_there_is_not_made(scene: Scene, old: str, new: str) -> None:
    count, _ = scene.counter()
    assert old in MODULE
    module = imported(scene.folder, MODULE.replace(old, new))
    error = refused(scene, count)
    assert isinstance(error, errors.CannotMigrate)
    assert "another version" in str(error)
    assert module.events == []
    assert continues(scene, count)


def test_a_changed_docstring_makes_no_other_version(scene: Scene) -> None:
    count, _ = scene.counter()
    imported(scene.folder, MODULE.replace("def count(self) -> int:", 'def count(self) -> int:\n        """Count."""'))
    [moved, _] = scene.asker.migrate(count, to="new")
    assert moved() == 4


def test_a_constructor_that_fails_there_changes_nothing(scene: Scene) -> None:
    count, _ = scene.counter()
    assert isinstance(refused(scene, count, args=[1, 2, 3]), errors.CannotInstantiate)
    assert continues(scene, count)


def test_a_full_container_says_so(scene: Scene) -> None:
    count, shown = scene.counter()
    tickets = [prepare(scene).ticket for _ in range(target.MOST)]
    with pytest.raises(errors.Busy):
        scene.asker.migrate(count, to="new")
    for ticket in tickets:
        assert not ask(scene, "arrived")(ticket)
    [moved, _] = scene.asker.migrate(shown, to="new")
    assert moved() == 4


@pytest.mark.parametrize("method", ["save", "restore"])
def test_a_providers_exception_is_reported_and_changes_nothing(scene: Scene, method: str) -> None:
    count, _ = scene.counter()

    def fail() -> None:
        raise OSError("the disk is full")

    scene.module.before[method] = fail
    error = refused(scene, count)
    assert isinstance(error, errors.CannotMigrate)
    assert f"{method}_state" in str(error)
    assert "OSError: the disk is full. It continues where it was" in str(error)
    assert continues(scene, count)


@pytest.mark.parametrize("method", ["save", "restore"])
def test_a_provider_that_takes_too_long_with_its_state_stays(
    scene: Scene, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quiesce, "BUDGET_S", 0.05)
    count, _ = scene.counter()
    leave = threading.Event()
    scene.module.before[method] = lambda: leave.wait(30)
    error = refused(scene, count)
    leave.set()
    assert isinstance(error, errors.CannotMigrate)
    assert f"{method}_state has not ended after" in str(error)
    assert continues(scene, count)


def test_state_that_cannot_be_sent_stays_with_its_provider(scene: Scene) -> None:
    count = scene.offer(scene.module.Odd())["count"]
    with pytest.raises(TypeError, match="cannot be sent"):
        scene.asker.migrate(count, to="new")
    assert count() == 1


def test_a_client_that_may_not_administer_the_group_is_refused(scene: Scene) -> None:
    count, _ = scene.counter()
    scene.policy(chief="member")
    for attempt in (
        lambda: scene.asker.migrate(count, to="new"),
        lambda: scene.asker.save_state(count),
        lambda: scene.asker.restore_state(count, {"total": 0}),
    ):
        with pytest.raises(errors.AccessDenied, match="chief may not administer Counter in hall"):
            attempt()
    assert scene.module.events == []


def test_migrating_needs_the_right_to_administer_the_group(scene: Scene) -> None:
    scene.policy()
    [moved, _] = scene.asker.migrate(scene.counter()[0], to="new")
    assert moved() == 4


def test_a_client_that_loses_the_role_during_preparation_is_refused(scene: Scene) -> None:
    scene.policy()
    count, _ = scene.counter()
    scene.module.before["restore"] = lambda: scene.old.load_policy(scene.policy(chief="member", load=False))
    assert isinstance(refused(scene, count), errors.AccessDenied)
    scene.policy()
    assert continues(scene, count)


@pytest.mark.parametrize(("who", "complaint"), [("new", "new may not register"), ("old", "old may not register")])
def test_both_sides_must_be_allowed_to_offer_it(scene: Scene, who: str, complaint: str) -> None:
    count, _ = scene.counter()
    path = scene.policy(**{who: "chief"})
    scene.old.load_policy(path)
    with pytest.raises(errors.AccessDenied, match=complaint):
        if who == "new":
            scene.asker.migrate(count, to="new")
        else:
            prepare(scene)


def ask(scene: Scene, name: str) -> Handle:
    """A function of the container it goes to, as ``old`` calls it."""
    return scene.old.find(where(name=name, group="trade", container="new"))


def prepare(scene: Scene) -> Any:
    kind = scene.module.Counter
    print_of = target.fingerprint(kind, (), scene.old._parts.codec)
    snapshot = target.ProviderSnapshot(class_path=path_of(kind), fingerprint=print_of, groups=("hall",))
    return ask(scene, "prepare_arrival")(snapshot)


def test_an_unfetched_prepared_provider_is_closed_when_it_expires(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(target, "TICKET_S", 0.05)
    ticket = prepare(scene).ticket
    wait_until(lambda: scene.module.events == ["made 1", "close 0"])
    with pytest.raises(errors.CannotMigrate, match="the prepared provider has expired"):
        ask(scene, "arrive")(ticket)


def test_an_unfetched_prepared_provider_is_closed_with_its_container(scene: Scene) -> None:
    prepare(scene)
    scene.new.close()
    assert scene.module.events == ["made 1", "close 0"]


def test_a_ticket_is_valid_once_and_only_for_its_container(scene: Scene) -> None:
    ticket = prepare(scene).ticket
    stranger = scene.asker.find(where(name="arrive", group="trade", container="new"))
    assert not scene.asker.find(where(name="arrived", group="trade", container="new"))(ticket)
    with pytest.raises(errors.CannotMigrate):
        stranger(ticket)
    ask(scene, "arrive")(ticket)
    with pytest.raises(errors.CannotMigrate):
        ask(scene, "arrive")(ticket)
    assert ask(scene, "arrived")(ticket)
    scene.memory.settle()
    assert len(scene.asker.services(where(name="count"))) == 1


def test_asking_whether_a_provider_arrived_prevents_a_later_arrival(scene: Scene) -> None:
    ticket = prepare(scene).ticket
    assert not ask(scene, "arrived")(ticket)
    assert scene.module.events == ["made 1", "close 0"]
    with pytest.raises(errors.CannotMigrate):
        ask(scene, "arrive")(ticket)


def test_a_migration_whose_caller_gave_up_moves_nothing(scene: Scene) -> None:
    count, _ = scene.counter()
    migrate = scene.asker.find(where(name="migrate", group="trade", container="old"))
    scene.module.before["save"] = lambda: time.sleep(0.3)
    with pytest.raises((errors.DeadlineExceeded, TimeoutError)):
        migrate.with_(deadline_s=0.2)(count, "new")
    wait_until(lambda: scene.old.locks() == [])
    assert continues(scene, count)


def test_a_container_that_dies_while_it_prepares_leaves_it_where_it_was(scene: Scene) -> None:
    count, _ = scene.counter()
    scene.module.before["restore"] = lambda: scene.memory.kill("new")
    with pytest.raises((errors.ContainerLost, errors.ServiceGone)):
        scene.asker.migrate(count, to="new")
    assert continues(scene, count)
