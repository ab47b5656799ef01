"""Complete, animatable 3D Gaussian avatars of partly hidden people, from a monocular video."""

__version__ = "0.1.0"
