"""A run: observe the data, decide, build the objects, run the stages, evaluate."""
