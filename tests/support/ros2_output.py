"""What the scripts that are nodes of ROS 2 tell the test, on standard output."""

import json
import threading
from typing import Any

_one_at_a_time = threading.Lock()


def tell(what: str, **reported: Any) -> None:
    """A line of JSON, whole: of two threads that print, the line of one may end up within the other's."""
    with _one_at_a_time:
        print(json.dumps({"what": what, **reported}), flush=True)
