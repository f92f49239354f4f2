"""Configuration files: gateway files, system files, and their tables."""
