"""The live method, shared by the nodes and the offline replay: initial poses, window by window adjusted."""
