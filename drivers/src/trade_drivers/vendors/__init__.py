"""One folder a vendor's protocol. Each has the same files under the same names."""
