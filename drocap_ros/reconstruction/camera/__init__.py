"""The camera's path from fixed points of the scene, with or without telemetry; arrays in, arrays out."""
