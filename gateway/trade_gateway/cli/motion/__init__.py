"""Commands that lock and stop."""
