"""The synthetic world of the demo and the tests: person, camera, keypoint observation, vehicle."""
