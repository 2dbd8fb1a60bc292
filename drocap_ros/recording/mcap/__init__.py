"""MCAP sessions: writing, streaming, recovery and their metadata."""
