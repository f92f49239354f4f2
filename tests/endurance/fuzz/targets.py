"""Everything that is fuzzed, in `make test-all` a little and in `make fuzz` for as long as one likes."""

from typing import Final

from tests.endurance.fuzz import _buses, _clients, _core, _files, _ros
from tests.endurance.fuzz._target import Target

TARGETS: Final[dict[str, Target]] = {
    target.name: target for room in (_core, _files, _clients, _ros, _buses) for target in room.TARGETS
}
