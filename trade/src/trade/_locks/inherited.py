"""A lock that another process holds and passed on to this one in its environment (``trade lock GROUP -- COMMAND``)."""

import json
from typing import Final

import msgspec

from trade._context.outgoing import Claim
from trade._protocol.keys import Address
from trade._protocol.messages import Token
from trade.errors import ConfigurationError, LockLost

VARIABLE: Final = "TRADE_LOCK"


def passed_on(holder: Address, resources: tuple[str, ...], tokens: list[Token], claim: Claim) -> str:
    """What stands in the variable."""
    numbers = [[token.epoch, token.number] for token in tokens]
    claimed = msgspec.to_builtins(claim)
    return json.dumps([[holder.identity, holder.container, holder.epoch], list(resources), numbers, claimed])


class InheritedLock:
    """Every call of one container of this process is made under it, in all threads, while its holder lives.

    Args:
        text: what `passed_on` gave.
        owner: the container of this process that makes the calls.

    Raises:
        ConfigurationError: the text is something else.
    """

    def __init__(self, text: str, owner: Address) -> None:
        self.owner: Final = owner
        try:
            holder, resources, tokens, *claimed = json.loads(text)
            self._holder = Address(*map(str, holder))
            self._resources = tuple(map(str, resources))
            self._tokens = [Token(str(epoch), int(number)) for epoch, number in tokens]
            self.claim: Final = msgspec.convert(claimed[0], Claim) if claimed else Claim()
        except (ValueError, TypeError, RecursionError):
            problem = "is what `trade lock` passes to the command it runs; unset it"
            raise ConfigurationError(where=VARIABLE, problem=problem) from None
        self._lost = ""
        """Why, once it is."""

    @property
    def held(self) -> bool:
        """Whether it holds, as far as one can know here: those who granted it judge."""
        return not self._lost

    def tokens(self) -> list[Token]:
        """What shows it to those it was granted by; raises LockLost once its holder is gone."""
        if self._lost:
            raise LockLost(resources=self._resources, reason=self._lost)
        return self._tokens

    def refused(self, by: Address, error: LockLost) -> None:  # noqa: ARG002
        """A call under it was refused."""
        if not set(self._resources).isdisjoint(error.resources):
            self._lost = self._lost or error.reason

    def lost(self, address: Address) -> None:
        """A container has ended or cannot be reached."""
        if address == self._holder:
            self._lost = f"{address.container}, which held it, has ended or cannot be reached"
