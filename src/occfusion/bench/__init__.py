"""Speed, memory and error of the rasteriser and of the parts of a training step."""
