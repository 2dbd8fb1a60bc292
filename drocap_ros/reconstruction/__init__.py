"""From 2D tracks to 3D motion: the paper's single-view start, bundle adjustment, and what goes beyond."""
