"""Moves a provider with its state to another container, and creates providers on request."""
