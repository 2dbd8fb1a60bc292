"""The simulated flight of the demo: pilot, person, camera, truth."""
