"""``drocap demo``: a whole simulated capture flight."""
