"""The live methods over sliding windows, as the nodes and the offline replay run them."""
