"""The aircraft: frames, vehicle state from MAVLink messages, and the link to the autopilot."""
