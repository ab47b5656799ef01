"""Data folders to frames: readers, simulated occlusion, and the LightningDataModules over them."""
