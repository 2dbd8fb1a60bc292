"""What the nodes share: topics, conversions, parameters, life cycle, processes."""
