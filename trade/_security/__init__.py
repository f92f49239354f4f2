"""Access policies, the decisions that follow from them, and certificates."""
