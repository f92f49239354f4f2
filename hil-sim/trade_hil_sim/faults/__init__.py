"""Scripted faults, and a method of the client for each."""
