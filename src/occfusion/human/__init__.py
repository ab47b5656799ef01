"""The human: body, canonical Gaussians, deformation, and the avatar that joins them."""

from occfusion.human.avatar import Avatar
from occfusion.human.avatar_file import load_avatar, save_avatar, write_gaussians_ply
from occfusion.human.body import Body, embedded_body, load_body
from occfusion.human.gaussians import Gaussians

__all__ = [
    "Avatar",
    "Body",
    "Gaussians",
    "embedded_body",
    "load_avatar",
    "load_body",
    "save_avatar",
    "write_gaussians_ply",
]
