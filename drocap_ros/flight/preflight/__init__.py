"""Before a flight: what was measured on the link, and what of it and of the configuration is missing."""
