"""A provider continues in another container, with its state, and is never alive twice."""

import threading

import pytest
from msgspec import structs

from tests.support.waiting import wait_until
from tests.unit.trade.moving_providers import Scene
from trade import HookEvent, service, where
from trade._migration import source as _departing
from trade.errors import ConfigurationError, LockedByOther, NoSuchService, ServiceGone, TooManyServices

pytestmark = pytest.mark.virtual_time


def test_a_migrated_provider_keeps_its_state_its_groups_and_its_meta(scene: Scene) -> None:
    count, _ = scene.counter("hall", "hall.door", meta={"floor": 2})
    moved = {one.name: one for one in scene.asker.migrate(count, to="new")}
    assert scene.module.events == ["save", "made 1", "restore 3", "close 3"]
    scene.memory.settle()
    found = scene.asker.find(where(name="count"))
    assert (found, found.container) == (moved["count"], "new")
    assert (found.groups, found.meta) == (("hall", "hall.door"), {"floor": 2})
    assert (found(), moved["shown"]()) == (4, 4)


def test_handles_from_before_say_where_it_went_and_do_not_follow(scene: Scene) -> None:
    count, _ = scene.counter()
    here = scene.old.find(where(name="count"))
    [moved, _] = scene.asker.migrate(count, to="new")
    scene.memory.settle()
    for stale in (count, here):
        with pytest.raises(ServiceGone, match=r"has moved to container new\. Look it up again") as gone:
            stale()
        assert gone.value.moved_to == f"{moved.key.address}/hall/{moved.key.provider}"


def test_the_container_it_left_answers_who_has_not_heard_of_it(scene: Scene) -> None:
    count, _ = scene.counter()
    count()
    hear_again = scene.memory.lose(lambda one: one.source == "old" and one.key.startswith("registry/hall/"))
    [moved, _] = scene.new.migrate(where(name="count"), to="new")
    assert count.alive
    with pytest.raises(ServiceGone) as gone:
        count()
    assert gone.value.moved_to == f"{moved.key.address}/hall/{moved.key.provider}"
    hear_again()


@pytest.mark.parametrize("name", ["count", "*"])
def test_a_constraint_names_the_provider_whose_services_alone_match(scene: Scene, name: str) -> None:
    scene.counter()
    [count, shown] = scene.asker.migrate(where(name=name, group="hall"), to="new")
    assert (count.name, shown.name, shown()) == ("count", "shown", 3)


def test_one_provider_is_moved_and_not_several_or_none(scene: Scene) -> None:
    scene.counter()
    scene.counter()
    with pytest.raises(TooManyServices):
        scene.asker.migrate(where(group="hall"), to="new")
    with pytest.raises(NoSuchService):
        scene.asker.migrate(where(group="cellar"), to="new")
    assert scene.module.events == []


def test_it_is_withdrawn_before_it_is_offered_there(scene: Scene) -> None:
    count, _ = scene.counter()
    seen: list[list[str]] = []
    there = where(name="count")
    scene.asker.joined(there, lambda _: seen.append([one.container for one in scene.asker.services(there)]))
    scene.asker.migrate(count, to="new")
    scene.memory.settle()
    wait_until(lambda: seen)
    assert seen == [["new"]]


def test_a_provider_can_migrate_repeatedly(scene: Scene) -> None:
    scene.counter()
    for to in ("new", "old", "new"):
        scene.asker.migrate(where(name="count"), to=to)
        scene.memory.settle()
        scene.asker.call(where(name="count"))
    assert scene.asker.call(where(name="shown")) == 6
    assert [event for event in scene.module.events if event.startswith("close")] == ["close 3", "close 4", "close 5"]


def test_what_was_instantiated_is_made_again_with_its_arguments_and_belongs_there(scene: Scene) -> None:
    scene.old.system.instantiate("migrants_there:Counter", {"step": 5}, ["hall"])
    scene.memory.settle()
    [count, _] = scene.asker.migrate(where(name="count"), to="new")
    scene.memory.settle()
    assert count() == 5
    with pytest.raises(ConfigurationError, match="not made by instantiate"):
        scene.old.system.terminate(count)
    scene.module.events.clear()
    scene.new.system.terminate(count)
    scene.old.close()
    assert scene.module.events == ["close 5"]


def test_other_arguments_are_given_with_the_order(scene: Scene) -> None:
    [count, _] = scene.asker.migrate(scene.counter()[0], to="new", args={"step": 7})
    assert count() == 10


def test_a_migrated_provider_without_state_starts_afresh(scene: Scene) -> None:
    scene.offer(scene.module.Forgetful())
    [greet] = scene.asker.migrate(where(name="greet"), to="new")
    assert (greet.container, greet()) == ("new", "hello")


def test_a_call_during_a_migration_is_refused_with_the_reason(scene: Scene) -> None:
    count, _ = scene.counter()
    heard: list[BaseException | None] = []
    scene.module.before["restore"] = lambda: heard.append(count.start().exception(30))
    [moved, _] = scene.asker.migrate(count, to="new")
    [refused] = heard
    assert isinstance(refused, LockedByOther)
    assert (refused.owner, refused.purpose) == ("old/old", "migrating to container new")
    assert moved() == 4


def test_a_call_that_runs_ends_first(scene: Scene) -> None:
    count, shown = scene.counter()
    inside, leave = threading.Event(), threading.Event()

    def linger() -> None:
        inside.set()
        leave.wait(30)

    scene.module.before["count"] = linger
    run = count.start()
    assert inside.wait(30)
    scene.module.before["count"] = lambda: None
    moving = threading.Thread(target=lambda: scene.asker.migrate(shown, to="new"))
    moving.start()
    others: list[BaseException | None] = []

    def is_held_still() -> bool:
        others.append(count.start().exception(30))
        return others[-1] is not None

    wait_until(is_held_still)
    assert isinstance(others[-1], LockedByOther)
    assert "save" not in scene.module.events
    leave.set()
    moving.join(30)
    assert run.result(30) > 3
    assert f"restore {3 + len(others)}" in scene.module.events


@pytest.mark.parametrize(
    "busy",
    [
        [(80.0, 5.0, 0.0), (10.0, 90.0, 7.0), (40.0, 1.0, 3.0)],  # by the CPU of their hosts
        [(30.0, 5.0, 8.0), (30.0, 90.0, 2.0), (30.0, 1.0, 4.0)],  # by calls, where that is the same
        [(None, 50.0, 0.0), (None, 20.0, 7.0), (None, 30.0, 3.0)],  # by their own CPU, where hosts do not tell
    ],
)
def test_a_provider_moves_to_the_least_busy_of_several_matching_containers(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, busy: list[tuple[float | None, float, float]]
) -> None:
    for number, (host, own, calls) in enumerate(busy, 1):
        meter = scene.memory.container(f"new-{number}", instantiable=["migrants_there:*"])._parts.load_meter
        reported = structs.replace(meter.read(), host_cpu_percent=host, cpu_percent=own, calls_per_s=calls)
        monkeypatch.setattr(meter, "read", lambda reported=reported: reported)
    scene.memory.settle()
    [count, _] = scene.asker.migrate(scene.counter()[0], to="new-?")
    assert count.container == "new-2"


def test_a_container_that_does_not_report_its_load_comes_last(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_departing, "_ASK_S", 0.2)
    for name in ("new-1", "new-2", "new-3"):
        scene.memory.container(name, instantiable=["migrants_there:*"])
    scene.memory.settle()
    scene.memory.lose(lambda one: one.source == "old" and one.key.split("/")[3:4] in (["new-1"], ["new-3"]))
    [count, _] = scene.asker.migrate(scene.counter()[0], to="new-*")
    assert count.container == "new-2"


class Ear:
    def __init__(self) -> None:
        self.heard: list[str] = []

    @service
    def hear(self, call: HookEvent) -> None:
        self.heard.append(call.service.container)


def test_hooks_by_constraint_are_attached_before_any_call_and_those_by_handle_end(scene: Scene) -> None:
    count, _ = scene.counter()
    by_constraint, by_handle = Ear(), Ear()
    [all_of, one_of] = [scene.asker.register(ear)[0] for ear in (by_constraint, by_handle)]
    scene.memory.settle()
    scene.asker.after_service(where(name="count"), all_of)
    scene.asker.after_service(count, one_of)
    count()
    [moved, _] = scene.asker.migrate(count, to="new")
    moved()
    wait_until(lambda: len(by_constraint.heard) == 2)
    assert by_constraint.heard == ["old", "new"]
    assert by_handle.heard == ["old"]


def test_notifications_by_constraint_call_it_where_it_is_and_those_by_handle_say_that_it_moved(
    scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    count, _ = scene.counter()
    _, shown = scene.asker.migrate(count, to="new")
    scene.memory.settle()
    scene.asker.once(where(name="count"))
    scene.asker.once(count)
    wait_until(lambda: shown() == 4)
    wait_until(lambda: "has moved to container new" in caplog.text)


def test_state_is_saved_and_restored_where_it_is(scene: Scene) -> None:
    count, shown = scene.counter()
    state = scene.asker.save_state(count)
    assert state == {"total": 3}
    count()
    scene.asker.restore_state(where(name="shown"), state)
    assert shown() == 3
    assert scene.module.events == ["save", "count", "restore 3"]


def test_what_has_no_state_gives_and_takes_none(scene: Scene) -> None:
    scene.offer(scene.module.Forgetful())
    with pytest.raises(ConfigurationError, match="needs save_state"):
        scene.asker.save_state(where(name="greet"))
    with pytest.raises(ConfigurationError, match="needs save_state"):
        scene.asker.restore_state(where(name="greet"), None)
