"""The caller's side of calls: handles, runs, targets, and the calls that wait for a reply."""
