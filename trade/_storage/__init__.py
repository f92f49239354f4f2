"""SQLite files, each with its own thread."""
