"""The human: body, canonical Gaussians, deformation, and the avatar that joins them."""

from occfusion.human.avatar import Avatar
from occfusion.human.avatar_file import load_avatar, save_avatar, write_gaussians_ply
from occfusion.human.body import Body, embedded_body, load_body
from occfusion.human.gaussians import Gaussians
from occfusion.human.pose_spline import PoseSpline

__all__ = [
    "Avatar",
    "Body",
    "Gaussians",
    "PoseSpline",
    "embedded_body",
    "load_avatar",
    "load_body",
    "save_avatar",
    "write_gaussians_ply",
]
