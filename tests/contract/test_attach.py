"""What every driver says when it refuses to attach; nothing is announced.

A vendor that a rule does not apply to names it in its rig, with the reason.
"""

import sys

import pytest

from tests.contract.rigs.base import SafetyRig
from trade.errors import ConfigurationError


def refused(rig: SafetyRig) -> str:
    announced: list[object] = []
    with pytest.raises(ConfigurationError) as error:
        rig.attach(register=lambda *given: announced.append(given))
    assert not announced
    assert not rig.written()
    return str(error.value)


def test_an_absent_device_is_named_with_what_to_check(rig: SafetyRig) -> None:
    rig.plug()
    rig.bench.sim.do(rig.absent)
    said = refused(rig)
    for part in (*rig.says_absent, str(rig.bench.sim.port)):
        assert part in said


def test_another_model_is_named_beside_the_one_expected(rig: SafetyRig) -> None:
    rig.swap()
    assert rig.says_model in refused(rig)


def test_a_lost_answer_is_forgiven(rig: SafetyRig) -> None:
    rig.plug()
    for fault in rig.lost:
        rig.bench.sim.do(fault)
    rig.attach()


def test_a_missing_library_is_named_with_the_command_that_installs_it(
    rig: SafetyRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.plug()
    package, library = rig.library
    for name in [name for name in sys.modules if name.startswith(f"{library}.")] + [library]:
        monkeypatch.setitem(sys.modules, name, None)
    for name in rig.importing:
        monkeypatch.delitem(sys.modules, f"trade_drivers.{name}", raising=False)
    said = refused(rig)
    assert f"needs {package} " in said
    assert f'pip install "trade-drivers[{rig.vendor}]"' in said


def test_nothing_is_announced_and_the_port_is_free_when_announcing_fails(rig: SafetyRig) -> None:
    announced: list[object] = []

    def register(provider: object, _: object) -> None:
        if announced:
            raise ConfigurationError(problem="it is full")
        announced.append(provider)

    with pytest.raises(ConfigurationError, match="it is full"):
        rig.attach(register=register, deregister=announced.remove)
    assert not announced
    rig.attach()
