"""All that a phrase can stand for, and what a dialogue does itself."""

from collections.abc import Mapping
from typing import Final

from trade_gateway.language._motion_orders import MOTION_ORDERS
from trade_gateway.language._orders import ORDERS
from trade_gateway.language._questions import QUESTIONS
from trade_gateway.language._requests import Answer, Gaps, Request, Requester
from trade_gateway.language._states import STATES


def _in_dialogue(_asker: Requester, _gaps: Gaps) -> Answer:
    raise NotImplementedError  # the dialogue handles it before


DIALOGUE: Final[Mapping[str, Request]] = {
    "again": Request(("name",), (), _in_dialogue),
    "yes": Request((), (), _in_dialogue, is_order=True),
    "no": Request((), (), _in_dialogue),
}
"""What refers to the sentence before: the last question with another name, a yes and a no."""

REQUESTS: Final[Mapping[str, Request]] = {**QUESTIONS, **STATES, **ORDERS, **MOTION_ORDERS, **DIALOGUE}
"""Questions and orders by their names in the lexicon."""
