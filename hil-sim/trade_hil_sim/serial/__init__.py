"""Serial lines on pseudo-terminals, and buses of devices on them."""
