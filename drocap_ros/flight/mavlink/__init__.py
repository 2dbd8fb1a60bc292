"""MAVLink: link, commands, dialects of the autopilots, and vehicle state."""
