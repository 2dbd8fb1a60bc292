"""The closed flight loop in simulated time, with faults and with rendered images."""
