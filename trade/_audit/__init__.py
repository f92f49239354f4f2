"""The audit record: events, the thread that writes them, the file, and its hash chain."""
