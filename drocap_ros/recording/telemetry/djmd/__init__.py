"""The timed-metadata track ``djmd`` inside the video files of DJI drones."""
