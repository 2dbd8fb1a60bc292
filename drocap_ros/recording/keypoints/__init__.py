"""2D keypoints out of the files of other tools."""
