"""A lock that another process holds and passed on to this one in its environment (``trade lock GROUP -- COMMAND``)."""

import json
from typing import Final

import msgspec

from trade._context.outgoing import Claim
from trade.errors import ConfigurationError, LockLost
from trade.protocol.keys import Address
from trade.protocol.messages import Token

VARIABLE: Final = "TRADE_LOCK"


def passed_on(holder: Address, resources: tuple[str, ...], tokens: list[Token], claim: Claim) -> str:
    """The value of the variable."""
    numbers = [[token.epoch, token.number] for token in tokens]
    claimed = msgspec.to_builtins(claim)
    return json.dumps([[holder.identity, holder.container, holder.epoch], list(resources), numbers, claimed])


class InheritedLock:
    """A lock around every call of one container of this process, in all threads, while its holder lives.

    Args:
        text: the value that `passed_on` returned.
        owner: the container of this process that makes the calls.

    Raises:
        ConfigurationError: the text has another form.
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
        """Why it is lost; empty if it is not."""

    @property
    def held(self) -> bool:
        """Whether it holds, as far as is known here: the containers that granted it decide."""
        return not self._lost

    def tokens(self) -> list[Token]:
        """Its proofs for the containers that granted it; raises LockLost once its holder has ended."""
        if self._lost:
            raise LockLost(resources=self._resources, reason=self._lost)
        return self._tokens

    def refused(self, by: Address, error: LockLost) -> None:  # noqa: ARG002
        """Handles the refusal of a call made under it."""
        if not set(self._resources).isdisjoint(error.resources):
            self._lost = self._lost or error.reason

    def lost(self, address: Address) -> None:
        """Handles the end or loss of a container."""
        if address == self._holder:
            self._lost = f"{address.container}, which held it, has ended or cannot be reached"
