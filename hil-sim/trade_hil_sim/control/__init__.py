"""The simulator as a process or as threads: its server, its client, and its command line."""
