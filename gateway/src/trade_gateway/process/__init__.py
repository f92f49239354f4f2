"""Processes: signals as events, a kernel timer that kills, the parent's end, atomic files."""
