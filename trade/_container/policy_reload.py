"""Automatic reload of the policy: its files are checked every second, so that revoked identities are refused."""

import logging
import time
from collections.abc import Callable
from typing import Final, Protocol

from trade._security.authorizer import Authorizer
from trade._security.policy import different
from trade._security.policy_file import Seen
from trade._threads.scheduler import Scheduler
from trade.errors import ConfigurationError

_logger = logging.getLogger("trade")
_EVERY_NS: Final = 1_000_000_000
_AGAIN_NS: Final = 10 * _EVERY_NS
"""Refused files are read again after this time although they look the same: an error of reading may be over."""


class _Audit(Protocol):
    def changed(self, what: str, about: str, call: None) -> None: ...


def begin_watching(access: Authorizer, scheduler: Scheduler, audit: _Audit, recheck_access: Callable[[], None]) -> None:
    """Keeps a container's policy as its files are; wrong files are refused, and the earlier policy stays.

    Args:
        access: the policy in force.
        scheduler: checks the files, once a second.
        audit: records the changes.
        recheck_access: applies a changed policy.
    """
    _PolicyWatch(access, scheduler, audit, recheck_access)


class _PolicyWatch:
    def __init__(
        self, access: Authorizer, scheduler: Scheduler, audit: _Audit, recheck_access: Callable[[], None]
    ) -> None:
        self._access, self._audit, self._recheck_access = access, audit, recheck_access
        self._last: Seen = access.seen
        """The files at the last check: files that are being written get time to finish."""
        self._refused: Seen | None = None
        """Wrong files, which are logged once."""
        self._again_ns = 0
        scheduler.begin(self._look, time.monotonic_ns() + _EVERY_NS)

    def _look(self) -> int:
        now = self._access.look()
        due = now != self._refused or time.monotonic_ns() >= self._again_ns
        if now == self._last and now != self._access.seen and due:
            self._read(now)
        self._last = now
        return time.monotonic_ns() + _EVERY_NS

    def _read(self, now: Seen) -> None:
        before, path = self._access.policy, self._access.path
        assert before is not None and path is not None  # noqa: S101 - without a policy nothing is watched
        try:
            self._access.load(path)
        except ConfigurationError as wrong:
            if now != self._refused:
                _logger.warning("the policy was changed and is wrong, so the earlier one stays: %s", wrong)
            self._refused, self._again_ns = now, time.monotonic_ns() + _AGAIN_NS
            return
        self._refused = None
        after = self._access.policy
        assert after is not None  # noqa: S101 - it has just been read
        text = f"{path}: {', '.join(different(before, after)) or 'nothing is different'}"
        _logger.warning("read again: %s", text)
        self._audit.changed("policy read again", text, None)
        try:
            self._recheck_access()
        except Exception:
            _logger.exception("the changed policy %s could not be applied everywhere", path)
