"""Rotations, alignment, the body-fixed frame, bone lengths and interpolation, batched over leading axes."""
