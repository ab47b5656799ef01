"""What all tests share."""

import os

import torch

# tests work on small tensors, which more threads only slow down, the more so where two processes share the cores;
# thread counts are tested where they matter
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes that tests start
