"""What people type, checked: the error of a wrong word, and the services that words name."""

from trade import Constraint, Container, Handle, where
from trade.errors import ConfigurationError, TooManyServices


class UsageError(ConfigurationError):
    """The words of the command line are wrong: exit code 2."""


def asked_for(what: str, *, name: str | None, group: str | None, container: str | None = None) -> Constraint:
    """The constraint that words of the command line ask for.

    Raises:
        UsageError: they make none.
    """
    try:
        return where(name=name, group=group, container=container)
    except ConfigurationError as bad:
        raise UsageError(where=what, problem=bad.problem) from None


def find(visiting: Container, service: str, container: str | None, wait_s: float) -> Handle:
    """The service of a group and name; one of exactly this group goes before those beneath it.

    Raises:
        UsageError: the text names no service.
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
