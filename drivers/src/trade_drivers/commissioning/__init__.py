"""Finding devices on a bus, and giving them ids and rates."""
