"""The simulated vehicle: dynamics, autopilot dialects, loopback link."""
