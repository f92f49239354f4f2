"""Notifications: triggers, their actions, and the services that manage them."""
