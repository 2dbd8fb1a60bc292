"""Commands around a running graph: live, preflight, orbit, record, replay, top, view."""
