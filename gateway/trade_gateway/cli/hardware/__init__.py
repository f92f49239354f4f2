"""Commands that set hardware up."""
