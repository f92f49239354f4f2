"""Before and after calls: hooks on services, and the services that manage them."""
