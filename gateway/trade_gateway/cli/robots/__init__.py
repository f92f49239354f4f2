"""Commands that bring up robots, containers and networks."""
