"""The subject: where he is and how he moves, from keypoints and the pose of the camera."""
