"""The stages of the paper as LightningModules."""
