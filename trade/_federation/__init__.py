"""Federation, a container's side: its system's providers as another system sees them, and proxies of others."""
