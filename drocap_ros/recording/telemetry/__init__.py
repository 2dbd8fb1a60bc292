"""Telemetry logs beside a video, and states of the vehicle as camera poses."""
