"""From the camera to the world: metric scale and placement by telemetry."""
