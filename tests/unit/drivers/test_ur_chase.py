"""The set-point that moves towards its target: within its limits, without going beyond, whatever the targets."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from trade_drivers.vendors.ur._path import SetpointFilter

SPEED, ACCEL, STEP_S = 1.0, 2.5, 0.002


@given(st.lists(st.tuples(st.floats(-3, 3), st.integers(1, 400)), min_size=1, max_size=5))
@settings(max_examples=60, deadline=None)
def test_it_keeps_its_limits_and_comes_to_rest_at_the_last_target(targets: list[tuple[float, int]]) -> None:
    chase = SetpointFilter([0.0], SPEED, ACCEL)
    seen = [0.0, *(chase.step([target], STEP_S)[0] for target, steps in targets for _ in range(steps))]
    seen += [chase.step([targets[-1][0]], STEP_S)[0] for _ in range(4000)]
    speeds = [(b - a) / STEP_S for a, b in pairwise(seen)]
    assert max(abs(speed) for speed in speeds) <= SPEED * 1.001
    # the last step, onto the target, may be twice as hard
    assert max(abs(b - a) / STEP_S for a, b in pairwise([0.0, *speeds])) <= ACCEL * 2.001
    assert seen[-1] == targets[-1][0]


@given(st.floats(-3, 3))
@settings(max_examples=60, deadline=None)
def test_it_does_not_go_beyond_a_target_by_more_than_a_step_can_change(target: float) -> None:
    chase = SetpointFilter([0.0], SPEED, ACCEL)
    farthest = max(abs(chase.step([target], STEP_S)[0]) for _ in range(3000))
    assert farthest <= abs(target) + ACCEL * STEP_S**2
