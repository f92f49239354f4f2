"""What makes a method a service, and what is refused at registration."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import pytest

from trade import Container, Resource, service, where
from trade.errors import ConfigurationError, LockedByOther

pytestmark = pytest.mark.virtual_time


class Lamp:
    @service
    def switch(self, on: bool) -> bool:
        return on

    @service(effect="read", achieves=["known(brightness)"])
    def brightness(self) -> float:
        return 0.5

    def wiring(self) -> str:
        return "not a service"


class LampInterface(ABC):
    @abstractmethod
    @service(effect="read")
    def brightness(self) -> float: ...


class LampProtocol(Protocol):
    @service(effect="read")
    def brightness(self) -> float: ...


def names(container: Container) -> set[str]:
    return {handle.name for handle in container.services(where(local=True)) if handle.groups != ("trade",)}


def test_only_marked_methods_become_services(here: Container) -> None:
    here.register(Lamp())
    assert names(here) == {"switch", "brightness"}


def test_an_unmarked_default_actuates_and_says_what_it_needs(here: Container) -> None:
    switch, brightness = here.register(Lamp())
    assert (switch.effect, brightness.effect) == ("actuate", "read")


def test_register_returns_the_handles_of_the_services(here: Container) -> None:
    assert [handle.name for handle in here.register(Lamp(), "hall")] == ["switch", "brightness"]


def test_services_of_a_base_class_are_inherited(here: Container) -> None:
    class Chandelier(Lamp):
        pass

    here.register(Chandelier())
    assert names(here) == {"switch", "brightness"}


def test_an_overriding_method_inherits_the_mark(here: Container) -> None:
    class Dimmed(Lamp):
        def brightness(self) -> float:
            return 0.25

    here.register(Dimmed())
    brightness = here.find(where(name="brightness"))
    assert (brightness(), brightness.effect) == (0.25, "read")


def test_an_overriding_method_may_be_marked_differently(here: Container) -> None:
    class Odd(Lamp):
        @service(effect="stop")
        def switch(self, on: bool) -> bool:
            return not on

    here.register(Odd())
    assert here.find(where(name="switch")).effect == "stop"


def test_an_abstract_base_class_marks_its_implementations(here: Container) -> None:
    class Bulb(LampInterface):
        def brightness(self) -> float:
            return 1.0

    here.register(Bulb())
    assert here.find(where(name="brightness"))() == 1.0


def test_a_protocol_marks_classes_that_inherit_from_it(here: Container) -> None:
    class Bulb(LampProtocol):
        def brightness(self) -> float:
            return 1.0

    here.register(Bulb())
    assert here.find(where(name="brightness"))() == 1.0


def test_a_protocol_marks_classes_that_only_fit_it(here: Container) -> None:
    class Bulb:
        def brightness(self) -> float:
            return 1.0

    here.register(Bulb(), implements=[LampProtocol])
    assert here.find(where(name="brightness"))() == 1.0


def test_class_methods_and_static_methods_are_services_whichever_decorator_comes_first(here: Container) -> None:
    class Scale:
        factor = 2

        @classmethod
        @service(effect="read")
        def scaled(cls, value: int) -> int:
            return cls.factor * value

        @service(effect="read")
        @staticmethod
        def doubled(value: int) -> int:
            return 2 * value

        @service(effect="read")
        @classmethod
        def tripled(cls, value: int) -> int:
            return 3 * value

    here.register(Scale())
    assert [here.find(where(name=name))(3) for name in ("scaled", "doubled", "tripled")] == [6, 6, 9]


def test_a_single_text_counts_as_one_resource(here: Container) -> None:
    class Arm:
        @service(uses="gripper", achieves="open(gripper)")
        def open(self) -> None: ...

        @service(effect="stop")
        def stop(self) -> None: ...

    handle, _ = here.register(Arm())
    assert (handle.resources, handle.record.info.achieves) == (("gripper",), ("open(gripper)",))


def test_resources_of_the_object_count_for_what_actuates_only(here: Container) -> None:
    class Joint:
        resources = ("pan",)

        @service(effect="read")
        def angle(self) -> float:
            return 0.0

        @service(uses=["brake"])
        def move(self) -> None: ...

        @service(effect="stop")
        def stop(self) -> None: ...

    angle, move, _ = here.register(Joint())
    assert (angle.resources, move.resources) == ((), ("brake", "pan"))


def test_names_outside_ascii_are_no_obstacle(here: Container, there: Container) -> None:
    there.register(type("Größe", (Lamp,), {})())
    assert here.find(where(name="brightness"))() == 0.5


def test_a_service_may_have_the_longest_class_name(here: Container, there: Container) -> None:
    there.register(type("L" * 200, (Lamp,), {})())
    assert here.find(where(name="brightness"))() == 0.5


class MissesImplementation:
    pass


class StubOnly(LampProtocol):
    """Inherits the protocol's empty body, which would answer None."""


class Emptied(Lamp):
    switch = None  # type: ignore[assignment]


class Heater(Protocol):
    @service
    def warm(self) -> None: ...

    @service
    def cool(self) -> None: ...


class CancelsNothing:
    @service(cancel="halt")
    def walk(self) -> None: ...


class Unsendable:
    @service
    def take(self, callback: Callable[[], None]) -> None: ...


class UnsendableResult:
    @service
    def give(self) -> Callable[[], None]: ...  # type: ignore[empty-body]


class Variadic:
    @service
    def take(self, *values: int) -> None: ...


class Keywords:
    @service
    def take(self, **values: int) -> None: ...


class Unreadable:
    @service
    def take(self, value: "NoSuchName") -> None: ...  # type: ignore[name-defined]  # noqa: F821


class Unstoppable:
    @service(uses=["arm"])
    def move(self) -> None: ...


class UnstoppableResource:
    resources = ("arm",)

    @service
    def move(self) -> None: ...


class NoServices:
    def move(self) -> None: ...


S17 = 'it moves something but cannot be stopped; give it a method marked @service(effect="stop")'
UNDONE = "the interface has this service, but the class does not implement it"
REFUSED: dict[str, tuple[Any, ...]] = {
    "S17: uses something": (Unstoppable, f"Unstoppable: {S17}", "a"),
    "S17: is something": (UnstoppableResource, f"UnstoppableResource: {S17}", "a"),
    "no services": (NoServices, "NoServices: it has no services; mark methods of its class with @trade.service"),
    "interface not implemented": (
        MissesImplementation,
        f"MissesImplementation.brightness: {UNDONE}",
        (),
        (LampProtocol,),
    ),
    "protocol's own stub": (StubOnly, f"StubOnly.brightness: {UNDONE}"),
    "not callable": (Emptied, f"Emptied.switch: {UNDONE}"),
    "several missing": (
        Emptied,
        "Emptied: the interface has the services switch, warm, cool, but the class does not implement them",
        (),
        (Heater,),
    ),
    "cancel names nothing": (CancelsNothing, "CancelsNothing.walk: cancel='halt' names no service of this class"),
    "unsendable argument": (Unsendable, "a.take: argument 'callback' has a type that cannot be sent", "a"),
    "unsendable result": (UnsendableResult, "a.give: its result has a type that cannot be sent", "a"),
    "*args": (Variadic, "a.take: a service cannot take *values: int; name its parameters", "a"),
    "**kwargs": (Keywords, "a.take: a service cannot take **values: int; name its parameters", "a"),
    "unreadable annotation": (Unreadable, "a.take: its annotations cannot be read", "a"),
    "empty segment": (Lamp, "Lamp: 'rosie..head' is no group; use words joined by dots", "rosie..head"),
    "blank": (Lamp, "Lamp: 'my robot' is no group", "my robot"),
    "wildcard": (Lamp, "Lamp: 'rosie.*' is no group", "rosie.*"),
    "slash": (Lamp, "Lamp: 'a/b' is no group", "a/b"),
    "empty group": (Lamp, "Lamp: '' is no group", [""]),
    "not a text": (Lamp, "Lamp: 5 is no group", [5]),
    "too long": (Lamp, "is no group", "a" * 81),
    "reserved": (Lamp, "'trade' is reserved", "trade"),
    "beneath the reserved": (Lamp, "'trade' is reserved", "trade.mine"),
}
"""An object, what is said of it, its groups, and the interfaces that it claims."""


@pytest.mark.parametrize("case", REFUSED.values(), ids=list(REFUSED))
def test_an_unusable_service_is_refused_at_registration_with_place_and_remedy(
    here: Container, case: tuple[Any, ...]
) -> None:
    def is_refused(kind: type, message: str, groups: Any = (), implements: Any = ()) -> None:
        with pytest.raises(ConfigurationError) as refused:
            here.register(kind(), groups, implements=implements)
        assert message in str(refused.value)

    is_refused(*case)
    assert names(here) == set()


def test_an_object_is_registered_only_once(here: Container) -> None:
    lamp = Lamp()
    here.register(lamp)
    with pytest.raises(ConfigurationError, match="Lamp: this object is registered already; deregister it first"):
        here.register(lamp, "elsewhere")


def test_an_object_may_be_registered_again_after_it_was_deregistered(here: Container) -> None:
    lamp = Lamp()
    here.register(lamp)
    here.deregister(lamp)
    here.register(lamp)
    assert here.find(where(name="brightness"))() == 0.5


def test_an_object_that_was_refused_may_be_registered_properly(here: Container) -> None:
    lamp = Lamp()
    with pytest.raises(ConfigurationError):
        here.register(lamp, "trade")
    here.register(lamp, "hall")
    assert names(here) == {"switch", "brightness"}


def test_two_objects_of_one_class_are_two_providers(here: Container) -> None:
    here.register(Lamp(), "hall")
    here.register(Lamp(), "attic")
    assert [handle.label for handle in here.services(where(name="switch"))] == ["attic.switch", "hall.switch"]


def test_deregistering_what_is_not_registered_is_refused(here: Container) -> None:
    with pytest.raises(ConfigurationError, match="Lamp: it is not registered in this container"):
        here.deregister(Lamp())


def test_an_unknown_effect_is_refused_where_it_is_written() -> None:
    with pytest.raises(ConfigurationError, match="effect must be one of read, note, actuate, stop, not 'look'"):
        service(effect="look")  # type: ignore[call-overload]


def test_a_property_cannot_be_a_service() -> None:
    with pytest.raises(ConfigurationError, match="@service decorates a method"):

        class Wrong:
            @service
            @property
            def value(self) -> int:
                return 1


def test_a_parameter_without_a_type_hint_is_refused_with_what_to_write(here: Container) -> None:
    class Careless:
        @service
        def move(self, angle_rad, speed=1.0): ...  # type: ignore[no-untyped-def]

    with pytest.raises(
        ConfigurationError, match=r"robot\.move: argument 'angle_rad' has no type hint; write angle_rad: "
    ):
        here.register(Careless(), "robot")


class Diary:
    def __init__(self) -> None:
        self.lines: list[str] = []

    @service(effect="note")
    def write(self, line: str) -> None:
        self.lines.append(line)

    @service
    def burn(self) -> None:
        self.lines.clear()


def test_a_service_with_effect_note_is_neither_locked_nor_blocked_by_a_lock(here: Container, there: Container) -> None:
    diary = Diary()
    here.register(diary, "hall.diary")
    write = there.find(where(name="write", group="hall.diary"))
    burn = there.find(where(name="burn", group="hall.diary"))
    with here.lock(where(group="hall")) as lock:
        assert [name.rpartition("/")[2] for name in lock.resources] == ["burn"]
        write("rain")
        with pytest.raises(LockedByOther):
            burn()
    assert diary.lines == ["rain"]
    with pytest.raises(ConfigurationError, match="only writes something down, so it cannot be locked"):
        there.lock([write]).acquire()


def test_a_service_with_effect_note_uses_no_resources() -> None:
    with pytest.raises(ConfigurationError, match="a note uses no resources"):
        service(effect="note", uses=["pen"])(lambda: None)


def test_a_class_in_the_place_of_an_object_is_refused(here: Container) -> None:
    with pytest.raises(ConfigurationError, match="Lamp: it is a class; register an object of it"):
        here.register(Lamp, "lab")


class Press:
    """Names the same thing as an object and by its name."""

    def __init__(self) -> None:
        self.resources = [Resource("lab.press")]

    @service(uses=["lab.press", "lab.door"])
    def close(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


def test_what_an_object_and_a_mark_name_is_one_resource(here: Container) -> None:
    press = Press()
    here.register(press, "lab")
    close = here.find(where(name="close"))
    assert close.resources == ("lab.press", "lab.door")
    with here.lock([close]):
        assert press.resources[0].holder is not None
    here.deregister(press)
    here.register(Press(), "lab")  # as nothing of the first one is left
