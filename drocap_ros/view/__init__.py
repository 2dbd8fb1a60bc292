"""Motions in the Rerun viewer (``drocap view``)."""
