"""The operator's desk, and the page in a browser that shows a running flight and commands it (docs/station.md)."""
