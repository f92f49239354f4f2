"""Access policies, the decisions they lead to, and certificates."""
