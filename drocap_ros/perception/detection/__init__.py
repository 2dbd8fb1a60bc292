"""Person detection: letterbox, decoding of each layout, non-maximum suppression."""
