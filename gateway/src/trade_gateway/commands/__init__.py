"""The commands of ``trade``, a module each, and how all of them print."""
