"""What naive code makes of calibration, calls within calls, discovery and rights. Each changes one function."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.contract.complaints.hosts import Wifi
from trade._security.policy import Decision, Policy
from trade._threads.channel_workers import WorkerPool
from trade.transport.base import ChannelClosed


def the_devices_zero_is_taken_as_it_is(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.joints.serial._axis.ServoAxis.zero_moved", lambda *_: "")


def one_thread_serves_all_calls(patch: pytest.MonkeyPatch) -> None:
    def main(self: WorkerPool) -> None:
        while not self._closed:
            try:
                self._work(self._channel.receive())
            except ChannelClosed:
                return

    patch.setattr(WorkerPool, "_main", main)


def containers_are_searched_by_multicast(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Wifi, "link", Wifi.link_by_multicast)


def a_rule_covers_whatever_begins_like_it(patch: pytest.MonkeyPatch) -> None:
    decide = Policy.decide

    def by_letters(self: Policy, who: str, verb: str, group: str) -> Decision:
        covered = [one for one in self.groups_of(who, [verb]) if group.startswith(one)]
        return decide(self, who, verb, covered[0] if covered else group)

    patch.setattr(Policy, "decide", by_letters)


def a_check_has_rules_of_its_own(patch: pytest.MonkeyPatch) -> None:
    def decision(policy: Policy, who: str, verb: str, what: str) -> Decision:
        return Policy(policy.roles.values(), policy.identities).decide(who, verb, what)  # revoked or not

    patch.setattr("trade_gateway.cli.rights._policy._decision", decision)


def the_default_system_is_named_after_the_host(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade._settings.default_system", lambda: f"tom@{socket.gethostname()}")


def estops_of_earlier_names_are_ignored(patch: pytest.MonkeyPatch) -> None:
    def none(_base: Path, _system: str) -> Iterator[Path]:
        return iter(())

    patch.setattr("trade._estop.store.earlier_folders", none)
