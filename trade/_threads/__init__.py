"""Threads and time: a scheduler, a thread pool, channel workers, a condition that Ctrl-C can interrupt."""
