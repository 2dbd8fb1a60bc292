"""Commands around a running graph: live, orbit, record, replay, top, view."""
