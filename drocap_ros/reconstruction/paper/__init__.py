"""The paper, found by its equations: single-view initialization, equations (2) to (4), and the baseline MF+NNM."""
