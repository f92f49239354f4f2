"""Checks command-line words: the usage error, and the services that the words name."""

from trade import Constraint, Container, Handle, where
from trade.errors import ConfigurationError, TooManyServices


class UsageError(ConfigurationError):
    """A usage error: wrong words on the command line; exit code 2."""


def asked_for(what: str, *, name: str | None, group: str | None, container: str | None = None) -> Constraint:
    """Builds a constraint from words of the command line.

    Raises:
        UsageError: the words are no valid constraint.
    """
    try:
        return where(name=name, group=group, container=container)
    except ConfigurationError as bad:
        raise UsageError(where=what, problem=bad.problem) from None


def find(visiting: Container, service: str, container: str | None, wait_s: float) -> Handle:
    """Finds a service by group and name; an exact group match wins over groups beneath it.

    Raises:
        UsageError: the text does not name a service.
    """
    group, _, name = service.rpartition(".")
    constraint = asked_for(f"service {service!r}", name=name or service, group=group or None, container=container)
    try:
        return visiting.find(constraint, wait_s=wait_s)
    except TooManyServices:
        exact = [handle for handle in visiting.services(constraint) if group in handle.groups]
        if len(exact) == 1:
            return exact[0]
        raise
