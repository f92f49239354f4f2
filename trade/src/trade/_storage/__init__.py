"""SQLite files, each with a thread of its own."""
