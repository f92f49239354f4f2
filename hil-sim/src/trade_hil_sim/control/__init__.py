"""The simulator as a process: its server, its client, and its command line."""
