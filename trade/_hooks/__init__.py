"""Hooks: services called before and after other ones, and the services that manage hooks."""
