"""How simulated devices move, and what is true of them."""
