"""What a container measures of itself: spans, metrics, log lines, and load."""
