"""Checks command-line words: the usage error, and the services that the words name."""

from typing import Any, Final, cast

from trade import Constraint, Container, Handle, where
from trade.errors import ConfigurationError

ABSENT: Final = 75
"""The exit code if a device of the robot file does not answer yet: EX_TEMPFAIL of sysexits.h, try again later."""


class UsageError(ConfigurationError):
    """A usage error: wrong words on the command line; exit code 2."""


def asked_for(
    what: str,
    *,
    name: str | None,
    group: str | None,
    container: str | None = None,
    needs: str | None = None,
    achieves: str | None = None,
) -> Constraint:
    """Builds a constraint from words of the command line.

    Raises:
        UsageError: the words are no valid constraint.
    """
    try:
        return where(name=name, group=group, container=container, needs=needs, achieves=achieves)
    except ConfigurationError as bad:
        raise UsageError(where=what, problem=bad.problem) from None


def find(visiting: Container, service: str, container: str | None, wait_s: float, pick: str | None = None) -> Handle:
    """Finds a service by group and name; an exact group match wins over groups beneath it.

    Args:
        visiting: the container of the command.
        service: the words.
        container: the name of the service's container, if given.
        wait_s: how long to wait for it, in seconds.
        pick: which one to take if several match, as for `trade.find`.

    Raises:
        UsageError: the text does not name a service.
    """
    try:
        return visiting.find(service, container=container, wait_s=wait_s, pick=cast("Any", pick))
    except ConfigurationError as bad:
        if pick is not None and "pick" in bad.problem:
            raise UsageError(where=f"--pick {pick}", problem=bad.problem) from None
        raise UsageError(where=f"service {service!r}", problem=bad.problem) from None
