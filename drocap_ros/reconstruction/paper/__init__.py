"""The paper by its equations: single-view initializer, equations (2) to (4), and the baseline MF+NNM."""
