"""The registry: which services exist, and how they are found: `where`, the index, suggestions for failed lookups."""
