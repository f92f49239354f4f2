"""The container: the public class, what it is built of, and its own services. The only place where all rooms meet."""
