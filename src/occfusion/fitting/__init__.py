"""Fitting a body to key points and masks: one shape for a clip, a pose and a place for every frame."""
