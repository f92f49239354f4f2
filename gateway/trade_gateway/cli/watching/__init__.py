"""Commands that watch a system: events, calls, logs, faults, audit, rules."""
