"""Simulated recordings: a capture flight with the errors of a detector, and a vehicle on a given path."""
