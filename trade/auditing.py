"""Reading and checking audit records. Containers write their own: see `trade.Settings.audit`."""

from trade._audit.events import Kind
from trade._audit.hash_chain import AuditRow, ChainCheck, Head, verify
from trade._audit.store import moved_aside_in, reading, records_in

__all__ = ["AuditRow", "ChainCheck", "Head", "Kind", "moved_aside_in", "reading", "records_in", "verify"]
