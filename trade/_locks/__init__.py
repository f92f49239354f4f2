"""The owner's side of locks: acquiring, renewing the lease, releasing."""
