"""Pictures and reports of a reconstructed motion."""
