"""What naive code makes of grippers and of an arm's controller. Each changes one function."""

from collections.abc import Sequence

import pytest

from trade import Handle
from trade_drivers.vendors.ur import _dashboard as dashboard
from trade_drivers.vendors.ur._arm_state import ArmStatus
from trade_gateway.recording import _sources as sources
from trade_gateway.ros.to_ros import _streams as streams


def joint_states_are_of_arms_alone(patch: pytest.MonkeyPatch) -> None:
    limbs = streams.limbs

    def without(found: Sequence[Handle], group: str, name: str) -> list[Handle]:
        return [one for one in limbs(found, group, name) if "Gripper" not in one.kinds]

    patch.setattr(streams, "limbs", without)


def recordings_are_of_arms_alone(patch: pytest.MonkeyPatch) -> None:
    moves = sources._moves
    patch.setattr(sources, "_moves", lambda handle, grouped: "Gripper" not in handle.kinds and moves(handle, grouped))


def no_error_mentions_the_slider(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(ArmStatus, "slowed", "")


def the_dashboard_answers_for_the_controller(patch: pytest.MonkeyPatch) -> None:
    def lacking(host: str, timeout_s: float) -> dict[str, str]:
        try:
            dashboard._greets(host, timeout_s)
        except dashboard.DashboardError as problem:
            return {name: str(problem) for name in dashboard.SERVICES}
        return {}

    patch.setattr("trade_drivers.vendors.ur.lacking", lacking)


def a_scan_asks_the_dashboard_alone(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.vendors.ur._driver.probe", lambda *_: None)
