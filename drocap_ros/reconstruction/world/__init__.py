"""Camera to world: metric scale and placement by telemetry."""
