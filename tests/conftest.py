"""What all tests share."""

import torch

# tests work on small tensors, which more threads only slow down; thread counts are tested where they matter
torch.set_num_threads(1)
