"""Commands that call services and ask about them."""
