"""What naive code makes of a placed object, an observer, a recording and a refusal. Each changes one function."""

import pytest

from trade import Handle
from trade._calls.client import CallClient
from trade._hooks.callee import Callee
from trade.errors import Stopped
from trade_gateway.cli.services import _call
from trade_gateway.recording._poller import Watch
from trade_hil_sim.serial._servo import ServoModel


def a_placed_object_starts_a_container_of_its_own(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade._container.default.first_host", lambda: None)


def a_callee_is_looked_up_once(patch: pytest.MonkeyPatch) -> None:
    now, found = Callee.now, dict[Callee, Handle]()

    def once(self: Callee, client: CallClient) -> Handle | None:
        if self not in found and (handle := now(self, client)) is not None:
            found[self] = handle
        return found.get(self)

    patch.setattr(Callee, "now", once)


def the_locks_of_a_group_have_its_name(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Watch, "_used", lambda _: set())


def a_simulated_servo_is_fresh_from_the_factory(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(ServoModel, "resemble", lambda *_: None)


def a_refusal_names_one_joint(patch: pytest.MonkeyPatch) -> None:
    describe = Stopped.describe

    def alone(self: Stopped) -> str:
        self.others = ()
        return describe(self)

    patch.setattr(Stopped, "describe", alone)


def every_word_is_json(patch: pytest.MonkeyPatch) -> None:
    value = _call._value  # pyright: ignore[reportPrivateUsage]
    patch.setattr(_call, "_value", lambda text, name, _kinds: value(text, name, set()))


def an_error_has_all_its_lines(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_gateway.terminal._output._place", lambda traceback, _: traceback.splitlines())


def a_description_has_what_a_caller_types(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Handle, "achieves", ())
