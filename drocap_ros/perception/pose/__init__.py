"""2D pose: decoding of each layout, and the calibrated uncertainty of keypoints."""
