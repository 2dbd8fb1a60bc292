"""The default method: a learned lifter, depth signs, and an adjustment with constant bone lengths."""
