"""2D tracks to 3D motion: the paper, the default method, the live windows and the placement in the world."""
