"""The ways to rasterise: `torch` is the specification, the others are measured against it."""
