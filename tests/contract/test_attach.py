"""What every driver says when it refuses to attach; nothing is announced.

A vendor that a rule does not apply to names it in its rig, with the reason.
"""

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
