"""What is checked of a data folder: before training, and in full by `check`."""
