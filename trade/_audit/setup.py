"""Opens the audit of a container, with a writer if its settings name a record."""

from contextlib import ExitStack

from trade._audit.events import Audit
from trade._counters import CallCounters
from trade._settings import Settings
from trade.protocol.keys import Address


def open_audit(settings: Settings, own: Address, leaving: ExitStack) -> Audit:
    """The audit of a container; the stack closes its writer, if it has one."""
    calls = CallCounters() if settings.metrics else None
    if settings.audit is None:
        return Audit(calls=calls)
    from trade._audit.writer import start_writing  # noqa: PLC0415 - without a record no database is needed

    writer = start_writing(settings, settings.audit, own)
    leaving.callback(writer.close)
    return Audit(writer.tell, own, reads=settings.audit_reads, calls=calls, record=writer)
