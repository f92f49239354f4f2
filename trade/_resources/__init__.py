"""The provider's side of locks: resources, permits, grants, leases, and the lock table."""
