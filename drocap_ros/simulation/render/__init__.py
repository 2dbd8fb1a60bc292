"""Rendered images of the simulated person."""
