"""Rotations, cameras, skinning and neighbours: pure functions on tensors."""
