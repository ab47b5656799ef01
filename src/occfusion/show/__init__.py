"""Showing an avatar: paths of cameras, pictures and their layers, films of several runs."""
