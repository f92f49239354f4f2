"""Moving a provider to another container with its state, and making providers on request."""
