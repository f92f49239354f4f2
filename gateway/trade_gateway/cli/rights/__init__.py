"""Commands for identities and rights."""
