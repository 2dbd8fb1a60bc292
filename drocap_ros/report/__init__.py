"""The report of a reconstructed motion: statistics, checks, one HTML page."""
