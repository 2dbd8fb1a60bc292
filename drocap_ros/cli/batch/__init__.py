"""``drocap batch``: many recordings, each reconstructed once, on one machine or a Dask cluster."""
