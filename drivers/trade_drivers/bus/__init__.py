"""The common base of all buses: an owner thread, cycles, jobs, deadlines, and locks on ports."""
