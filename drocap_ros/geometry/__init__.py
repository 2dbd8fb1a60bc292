"""Rotations, alignment of point sets and the body-fixed frame, batched over leading axes."""
