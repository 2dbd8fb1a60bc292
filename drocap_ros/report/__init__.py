"""Reports, previews and contact sheets of a reconstructed motion."""
