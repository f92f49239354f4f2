"""Commands that record, replay, export and show a system live."""
