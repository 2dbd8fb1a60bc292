"""The world of the demo: pilot, camera, truth."""
