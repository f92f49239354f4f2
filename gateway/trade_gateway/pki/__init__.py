"""The certificate authority of a system."""
