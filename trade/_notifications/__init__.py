"""Notifications: triggers, their actions, events of a container's states, and the services for all of these."""
