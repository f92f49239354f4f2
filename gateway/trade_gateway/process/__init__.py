"""Processes: signals as events, a kernel timer that kills, and the parent's end."""
