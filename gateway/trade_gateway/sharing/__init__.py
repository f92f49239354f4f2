"""The gateway as a guest in other systems: a container in each, and a `trade.sharing.Border` to it."""
