"""Single-subject tracking: search, association, identity, the belief in poses, and poses of others."""
