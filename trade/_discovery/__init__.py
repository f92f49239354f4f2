"""Discovery of other containers: dialling, announcing, listening, and querying again for missed messages."""
