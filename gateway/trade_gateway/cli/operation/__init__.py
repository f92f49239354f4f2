"""Commands that install a system, back it up and restore it."""
