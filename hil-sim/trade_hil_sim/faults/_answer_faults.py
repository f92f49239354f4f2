"""The active faults of answers on one bus."""

from trade_hil_sim.faults._commands import AnswerFault, AnswerPart, Mute


class _Active:
    """A fault and how often it has matched."""

    def __init__(self, fault: AnswerFault) -> None:
        self.fault = fault
        self.seen = 0

    @property
    def spent(self) -> bool:
        return self.fault.count is not None and self.seen >= self.fault.skip + self.fault.count

    def hits(self, ids: tuple[int, ...], instruction: str) -> bool:
        if self.spent or not self.fault.strikes(ids, instruction):
            return False
        self.seen += 1
        return self.seen > self.fault.skip


class ActiveFaults:
    """Faults in the order they were added; each affects the answers that it names."""

    def __init__(self) -> None:
        self._active: list[_Active] = []

    def add(self, fault: AnswerFault) -> None:
        """Activate a fault; faults act in the order they were added."""
        self._active.append(_Active(fault))

    def unmute(self, ids: tuple[int, ...] | None) -> None:
        """End the mutes that name one of these ids; without ids, all."""
        self._active = [a for a in self._active if not (isinstance(a.fault, Mute) and _overlap(a.fault.ids, ids))]

    def heal(self) -> None:
        """End all."""
        self._active.clear()

    @property
    def empty(self) -> bool:
        """Whether none is active."""
        return not self._active

    def silences(self, device_id: int, instruction: str) -> bool:
        """Whether this answer is suppressed; counts as one match."""
        return self.strikes(Mute, (device_id,), instruction)

    def strikes(self, fault_type: type[AnswerFault], ids: tuple[int, ...], instruction: str) -> bool:
        """Whether a fault of this kind affects this answer; counts as one match."""
        return any(a.hits(ids, instruction) for a in self._active if isinstance(a.fault, fault_type))

    def names(self, instruction: str) -> bool:
        """Whether a fault is about answers to this instruction only."""
        return any(a.fault.instruction == instruction for a in self._active if not a.spent)

    def shape(
        self, answer: bytes, ids: tuple[int, ...], instruction: str, *, but: tuple[type[AnswerFault], ...] = (Mute,)
    ) -> list[AnswerPart]:
        """The answer after the active faults were applied, except those of some kinds."""
        pieces = [AnswerPart(answer)]
        for active in self._active:
            if not isinstance(active.fault, but) and active.hits(ids, instruction):
                pieces = active.fault.shape(pieces)
        self._active = [active for active in self._active if not active.spent]
        return pieces


def _overlap(some: tuple[int, ...] | None, others: tuple[int, ...] | None) -> bool:
    return some is None or others is None or bool(set(some) & set(others))
