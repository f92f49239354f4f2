"""Printing a supervisor's reports about its child processes."""

from queue import SimpleQueue
from typing import TYPE_CHECKING

from rich.markup import escape

from trade_gateway.terminal._output import Output, complain

if TYPE_CHECKING:
    from trade_gateway.supervisor import News


def say_news(out: Output, waiting: "SimpleQueue[News]") -> None:
    """Prints the reports that wait."""
    while not waiting.empty():
        news = waiting.get()
        if out.as_json:
            out.data(news)
        elif news.bad:
            complain(news.text)
        else:
            out.say(escape(news.text))
