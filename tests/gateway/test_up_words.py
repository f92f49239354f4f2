"""``trade up``: what its words mean before anything is opened."""

import pytest

from trade_gateway.commands._output import UsageError
from trade_gateway.commands._up import ports_told


def test_a_port_of_the_command_line_may_have_any_sign_in_it() -> None:
    assert ports_told(["neck=/dev/by=id", "legs=socketcan:can1"]) == {"neck": "/dev/by=id", "legs": "socketcan:can1"}
    assert ports_told([]) == {}


@pytest.mark.parametrize("words", [["neck"], ["neck="], ["=/dev/ttyUSB0"], ["neck=/dev/ttyUSB0", "neck=/dev/ttyUSB1"]])
def test_what_is_no_port_of_a_part_is_refused(words: list[str]) -> None:
    with pytest.raises(UsageError, match="--port"):
        ports_told(words)
