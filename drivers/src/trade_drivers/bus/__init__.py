"""What every bus has in common: one owner thread, a cycle, jobs, deadlines, and locks on ports."""
