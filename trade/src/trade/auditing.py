"""Audit records for those who read and check them. Containers write their own: see `trade.Settings.audit`."""

from trade._audit.events import Kind
from trade._audit.hash_chain import AuditRow, Head, Verdict, verify
from trade._audit.store import moved_aside_in, reading, records_in

__all__ = ["AuditRow", "Head", "Kind", "Verdict", "moved_aside_in", "reading", "records_in", "verify"]
