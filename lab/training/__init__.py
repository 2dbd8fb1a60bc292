"""Training of the networks that ship (extra ``train``)."""
