"""Sessions: written by us, read from us and from others."""
