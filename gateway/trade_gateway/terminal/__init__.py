"""What commands of all products share: options, output, completion, and the system that a command connects to."""

from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output, complain
from trade_gateway.terminal._system_choice import choice_of, visitor

__all__ = ["Json", "Output", "choice_of", "complain", "visitor"]
