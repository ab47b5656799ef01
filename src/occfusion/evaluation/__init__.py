"""Avatars measured against held-out pictures and training views."""
