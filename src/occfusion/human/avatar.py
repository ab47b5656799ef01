"""The avatar: body, canonical Gaussians, deformation networks; pose in, posed Gaussians out (paper §3.2)."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from occfusion.errors import ConfigError
from occfusion.files.bodyfile import NUM_JOINTS
from occfusion.geometry.neighbours import Neighbours, nearest
from occfusion.geometry.normals import vertex_normals
from occfusion.geometry.skinning import bone_transforms
from occfusion.gpu.graphs import GraphedFunction
from occfusion.human.body import Body
from occfusion.human.carry import Carried, blend_columns, carry
from occfusion.human.deform import Binding, PoseRefiner, SkinningField, bind, skinning_weights
from occfusion.human.gaussians import Gaussians
from occfusion.human.memo import Memo, Unchanged
from occfusion.human.pose_spline import PoseSpline
from occfusion.human.shading import brightness, posed_colors, seen_colors, surface_normals
from occfusion.splat import Limits
from occfusion.types import Cloud, Pose

SKINNING_ROWS = 4
"""The skinning network learns from every so manieth Gaussian, those after them the next time. Neighbours on the body
have nearly the same place, and the network has the same answer for them."""


class Placed(NamedTuple):
    """What carries Gaussians into a pose.

    Attributes:
        transforms: of the bones, `[24, 4, 4]`.
        transl: the body's place, `[3]`, metres.
        weights: skinning weights, `[N, 24]`.
        rest_maps: canonical to rest, `[3, 4, N]`.
        offsets: displacements at rest, `[N, 3]`, metres.
    """

    transforms: Tensor
    transl: Tensor
    weights: Tensor
    rest_maps: Tensor
    offsets: Tensor


class Avatar(nn.Module):
    """A person as Gaussians on a body.

    The body's own arrays are not part of the state. A state of another number of Gaussians can be loaded.

    Args:
        body: the body, of the kind that the poses are for.
        sh_degree: highest band of spherical harmonics that will be used; see `active_sh_degree`.
        refine_pose: learn corrections of the body pose from the pose itself.
        pose_spline: corrections of the frames of one sequence, learned too; None: none.
        learn_skinning: learn offsets to the skinning weights.
        skinning_every: the skinning network costs more than all else here, so in training it is evaluated, and learns,
            at every k-th step only (`prepare`), of one in `SKINNING_ROWS` Gaussians, in turn; the last values of the
            others stand. Without gradients it always is, of all.
        key_light: by which colours change as surfaces turn, `[3]`, see `shading.brightness`; given, not learned.
        dilation: of the splats in pictures, square pixels (`splat.Limits`).
        gaussians: the Gaussians; one on each vertex of the body when None.
    """

    da_vertices: Tensor
    da_transforms: Tensor
    da_offsets: Tensor
    da_normals: Tensor
    key_light: Tensor | None
    skinning_offsets: Tensor

    def __init__(
        self,
        body: Body,
        *,
        sh_degree: int = 3,
        refine_pose: bool = True,
        pose_spline: PoseSpline | None = None,
        learn_skinning: bool = True,
        skinning_every: int = 4,
        key_light: Tensor | None = None,
        dilation: float = Limits.dilation,
        gaussians: Gaussians | None = None,
    ) -> None:
        super().__init__()
        if skinning_every < 1:
            raise ConfigError(f"skinning_every: {skinning_every} is not at least 1")
        self.body = body
        self.gaussians = Gaussians.on_body(body, sh_degree) if gaussians is None else gaussians
        self.pose_refiner = PoseRefiner() if refine_pose else None
        self.pose_spline = pose_spline
        self.skinning_field = SkinningField() if learn_skinning else None
        self.skinning_every = skinning_every
        self.dilation = dilation
        self.register_buffer("da_vertices", body.da_vertices(), persistent=False)
        self.register_buffer("da_transforms", body.da_transforms(), persistent=False)
        self.register_buffer("da_offsets", body.pose_offsets(body.da_rotations()), persistent=False)
        self.register_buffer("key_light", key_light)
        normals = vertex_normals(self.da_vertices.double().cpu().numpy(), body.faces.cpu().numpy())
        self.register_buffer("da_normals", torch.from_numpy(normals).to(body.v_template), persistent=False)
        # the network's last values in training; part of the state so that a resumed run goes on with the same ones
        self.register_buffer("skinning_offsets", body.v_template.new_zeros(0, NUM_JOINTS))
        self.to(body.v_template)
        self._active_sh_degree = 0
        self._is_skinning_due = True
        self._skinning_turn = 0
        self._memo = Memo()
        self._in_training = GraphedFunction(self._posed_by_tensors)

    # -- settings that follow the training ------------------------------------------------------------------

    @property
    def active_sh_degree(self) -> int:
        """Bands of spherical harmonics in use, 0 to the highest allocated."""
        return self._active_sh_degree

    @active_sh_degree.setter
    def active_sh_degree(self, degree: int) -> None:
        if not 0 <= degree <= self.gaussians.sh_degree:
            raise ValueError(
                f"active_sh_degree {degree}: this avatar has bands 0 to {self.gaussians.sh_degree}"
            )
        self._active_sh_degree = degree

    def prepare(self, step: int) -> None:
        """Gets ready for a training step: bounds the parameters, decides on the skinning network's turn.

        What follows depends on `step` and the state alone, so that a resumed run takes the same turns.
        """
        self.gaussians.constrain()
        turn, rest = divmod(step, self.skinning_every)
        self._is_skinning_due, self._skinning_turn = rest == 0, turn % SKINNING_ROWS

    def parameter_groups(self, rates: Mapping[str, float]) -> list[dict[str, Any]]:
        """Returns named parameter groups for one Adam.

        Args:
            rates: learning rates under `means`, `sh0`, `sh_rest`, `opacity`, `scales`, `quats`, `pose`,
                `pose_turns`, `pose_places`, `skinning`; others are ignored. The skinning network's is multiplied by
                `skinning_every`, since Adam moves it that many times less often.
        """
        groups = self.gaussians.parameter_groups(rates)
        if self.pose_refiner is not None:
            groups.append(
                {"name": "pose", "params": list(self.pose_refiner.parameters()), "lr": rates["pose"]}
            )
        if self.pose_spline is not None:
            spline = {"pose_turns": self.pose_spline.turns, "pose_places": self.pose_spline.places}
            groups += [{"name": name, "params": [p], "lr": rates[name]} for name, p in spline.items()]
        if self.skinning_field is not None:
            rate = rates["skinning"] * self.skinning_every
            groups.append({"name": "skinning", "params": list(self.skinning_field.parameters()), "lr": rate})
        return groups

    def refresh_vertex_index(self) -> Neighbours:
        """Ties each Gaussian to its nearest vertex of the canonical body; returns what was found."""
        found = nearest(self.gaussians.means.detach(), self.da_vertices)
        self.gaussians.set_vertex_index(found.indices[:, 0])
        return found

    def forget_skinning(self) -> None:
        """Drops the skinning network's last values, which belong to Gaussians that are no more."""
        self.skinning_offsets = self.skinning_offsets.new_zeros(0, NUM_JOINTS)

    # -- Gaussians in a pose --------------------------------------------------------------------------------

    def forward(self, pose: Pose, camera_centre: Tensor) -> Cloud:
        """Returns the Gaussians in a pose, world coordinates, coloured for a camera at `camera_centre [3]`.

        Viewing directions are turned back with each Gaussian, so that colours turn with the limbs.

        Raises:
            DataError: the pose has another number of joints, or more betas than the body.
        """
        gaussians, placed = self.gaussians, self._placed(pose)
        centre = camera_centre.to(gaussians.means)
        if self.training and torch.is_grad_enabled() and gaussians.means.is_cuda:
            lamp = () if self.key_light is None else (self.key_light,)
            means, covariances, opacities, colors = self._in_training(
                *placed, centre, self.da_normals, *gaussians.tensors(), *lamp, key=self._active_sh_degree
            )
        else:
            means, covariances, opacities, colors = self._posed(
                gaussians, placed, centre, self.da_normals, self.key_light
            )
        return Cloud(means, covariances, opacities, colors, self.dilation)

    def deform(self, pose: Pose, *, as_given: bool = False) -> Carried:
        """Returns centres and covariances in a pose, world coordinates, without colours.

        Args:
            pose: of the body.
            as_given: leave out what was learned of poses; skinning is as it is and learns nothing.
        """
        return _carried(self.gaussians, self._placed(pose, as_given=as_given))

    def _placed(self, pose: Pose, *, as_given: bool = False) -> Placed:
        """Returns what carries Gaussians into a pose.

        Joints are posed on the host, where a GPU would be started a hundred times.
        """
        means = self.gaussians.means
        pose = pose.to("cpu") if means.is_cuda else pose
        rotations, transl = self._given(pose) if as_given else self._corrected(pose)
        joints, offsets = self._shaped(pose.betas, rotations)
        transforms = bone_transforms(rotations, joints, self.body.parents, compiled=True)
        binding = self._binding(learns=not as_given)
        return Placed(transforms.to(means), transl.to(means), binding.weights, binding.rest_maps, offsets)

    def _posed(
        self,
        gaussians: Gaussians,
        placed: Placed,
        camera_centre: Tensor,
        normals: Tensor,
        key_light: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns centres, covariances, opacities and colours."""
        carried = _carried(gaussians, placed)
        colors = posed_colors(gaussians, self._active_sh_degree, carried, camera_centre, normals, key_light)
        return carried.means, carried.covariances, gaussians.opacities, colors

    def _posed_by_tensors(self, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns what `_posed` does, from tensors alone: a `Placed`, a camera, normals, Gaussians, a lamp if any."""
        given, of_gaussians = iter(tensors), len(self.gaussians.tensors())
        placed = Placed(*islice(given, len(Placed._fields)))
        camera_centre, normals = islice(given, 2)
        gaussians = Gaussians.of(tuple(islice(given, of_gaussians)))
        return self._posed(gaussians, placed, camera_centre, normals, next(given, None))

    def brightness(self, carried: Carried) -> Tensor | None:
        """Returns how bright the key light makes Gaussians in a pose, `[N]`; None under even light.

        A Gaussian faces where the body does at its vertex. Poses are not mended by light: it is without gradient.
        """
        if self.key_light is None:
            return None
        return brightness(self.surface_normals(carried), self.key_light)

    def surface_normals(self, carried: Carried) -> Tensor:
        """Returns the body's normals at posed Gaussians, `[3, N]`, world, of any length, without gradient."""
        return surface_normals(self.gaussians, carried, self.da_normals)

    def relight(self, key_light: Tensor | None) -> None:
        """Puts another lamp in place of the learned one, for showing: `[3]`, world, see `shading.brightness`."""
        self.key_light = None if key_light is None else key_light.to(self.da_normals)

    def _given(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Returns the joint rotations `[24, 3, 3]` and the translation `[3]` as the data have them."""
        rotations = self.body.rotations(pose.global_orient, pose.body_pose)
        return rotations, pose.transl.to(rotations)

    def _corrected(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Returns the joint rotations `[24, 3, 3]` and the translation `[3]` after all corrections."""
        rotations, transl = self._given(pose)
        if self.pose_refiner is not None:
            rotations = self.pose_refiner(pose.body_pose.reshape(-1), rotations)
        if self.pose_spline is not None and pose.frame_index is not None:
            rotations, transl = self.pose_spline(pose.frame_index, rotations, transl)
        return rotations, transl

    def canonical(self, camera_centre: Tensor) -> Cloud:
        """Returns the Gaussians in the Da pose around their own origin; the centres are the parameters.

        Args:
            camera_centre: the camera that colours are for, `[3]`, metres.
        """
        means: Tensor = self.gaussians.means
        roots = self.gaussians.roots()
        colors = seen_colors(self.gaussians, self._active_sh_degree, means, camera_centre, None)
        return Cloud(means, roots @ roots.transpose(1, 2), self.gaussians.opacities, colors, self.dilation)

    def _shaped(self, betas: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the joints of this shape at rest, and what shape and pose displace.

        Returns:
            `[24, 3]`, where the rotations are; and the blend shapes minus those of the canonical body, `[N, 3]`.
        """
        if betas.requires_grad:
            joints, offsets = self._shape(betas, rotations.device)
        else:
            # a video has one shape
            key = (self._rows_key(), rotations.device, tuple(betas.tolist()))
            joints, offsets = self._memo.get("shape", key, lambda: self._shape(betas, rotations.device))
        if self.body.posedirs is not None:
            by_pose = self.body.pose_offsets(rotations.to(offsets)) - self.da_offsets
            offsets = offsets + by_pose[self.gaussians.vertex_index]
        return joints, offsets

    def _shape(self, betas: Tensor, host: torch.device) -> tuple[Tensor, Tensor]:
        """Returns the joints at rest on a device, and the blend shapes of the Gaussians where they are."""
        body = self.body
        betas = body.check_betas(betas)
        joints = body.joint_template + body.joint_dirs[:, :, : len(betas)] @ betas
        offsets = body.shapedirs[:, :, : len(betas)] @ betas
        return joints.to(host), offsets[self.gaussians.vertex_index]

    # -- skinning weights, and when they are computed -------------------------------------------------------

    def _binding(self, *, learns: bool = True) -> Binding:
        if self.skinning_field is None:
            return self._memo.get(
                "fixed", self._rows_key(), lambda: bind(self._body_weights(), self.da_transforms)
            )
        if not torch.is_grad_enabled():
            return self._memo.get(
                "exact", (self._rows_key(), self._field_key()), lambda: self._bind_field()[0]
            )
        is_kept = len(self.skinning_offsets) == self.gaussians.num_gaussians
        if self.training and is_kept:
            key = (self._rows_key(), Unchanged(self.skinning_offsets))
            kept = self._memo.get("kept", key, lambda: self._bind_offsets(self.skinning_offsets))
            return self._learn_rows(kept) if self._is_skinning_due and learns else kept
        with torch.set_grad_enabled(learns):
            binding, offsets = self._bind_field()
        if self.training:
            self.skinning_offsets = offsets.detach()
        return binding

    def _learn_rows(self, kept: Binding) -> Binding:
        """Returns a binding with the rows that the skinning network has its turn with computed anew."""
        assert self.skinning_field is not None
        rows = torch.arange(self._skinning_turn, self.gaussians.num_gaussians, SKINNING_ROWS)
        rows = rows.to(self.skinning_offsets.device)
        offsets = self.skinning_field(self.gaussians.means.detach()[rows])
        some = bind(skinning_weights(self._body_weights()[rows], offsets), self.da_transforms)
        self.skinning_offsets = self.skinning_offsets.index_copy(0, rows, offsets.detach())
        return Binding(
            kept.weights.index_copy(0, rows, some.weights), kept.rest_maps.index_copy(2, rows, some.rest_maps)
        )

    def _bind_field(self) -> tuple[Binding, Tensor]:
        assert self.skinning_field is not None
        # the field moves Gaussians through their weights, not by pulling them to where weights are better
        offsets = self.skinning_field(self.gaussians.means.detach())
        return self._bind_offsets(offsets), offsets

    def _bind_offsets(self, offsets: Tensor) -> Binding:
        return bind(skinning_weights(self._body_weights(), offsets), self.da_transforms)

    def _body_weights(self) -> Tensor:
        weights = self.body.weights
        return self._memo.get("body", self._rows_key(), lambda: weights[self.gaussians.vertex_index])

    def _rows_key(self) -> Hashable:
        weights = self.body.weights
        return self.gaussians.revision, weights.dtype, weights.device

    def _field_key(self) -> Hashable:
        assert self.skinning_field is not None
        return Unchanged(self.gaussians.means, *self.skinning_field.parameters())

    # -- state ----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, int]:
        """Returns the state that is no tensor."""
        return {"active_sh_degree": self._active_sh_degree}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """Takes over what `get_extra_state` gave."""
        self.active_sh_degree = int(state["active_sh_degree"])

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        given = state_dict.get(prefix + "skinning_offsets")
        if given is not None and given.shape[1:] == self.skinning_offsets.shape[1:]:
            self.skinning_offsets = self.skinning_offsets.new_empty(given.shape)
        self._memo.clear()
        super()._load_from_state_dict(state_dict, prefix, *args)


def _carried(gaussians: Gaussians, placed: Placed) -> Carried:
    posed_maps = blend_columns(placed.weights, placed.transforms, placed.transl)
    return carry(
        gaussians.means, gaussians.raw_quats, gaussians.scales, placed.rest_maps, placed.offsets, posed_maps
    )
