"""Commands around networks and dictionaries."""
