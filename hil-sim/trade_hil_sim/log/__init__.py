"""The byte log, and questions about it."""
