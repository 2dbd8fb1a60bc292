"""Telemetry logs beside a video or in a session, as camera poses."""
