"""Studies behind the figure pages: calibration of the telemetry, the live method's poses at their publication."""
