"""Who calls, and under what: sessions, deadlines, call ids, and the calls in progress."""
