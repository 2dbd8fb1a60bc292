"""ONNX networks: which are known, how they are fetched, loaded and run."""
