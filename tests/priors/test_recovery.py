"""Recovery: faint Gaussians and floaters, fitted to silhouettes of which a side is always hidden."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from occfusion.geometry.camera import look_at, project_vertices
from occfusion.human import Avatar, embedded_body
from occfusion.human.body import Body
from occfusion.human.gaussians import Gaussians
from occfusion.human.rendering import Renderer
from occfusion.observation.bodyview import view_body
from occfusion.observation.crop import CANONICAL_ANGLES, view_canonical
from occfusion.observation.frames import observe_frames
from occfusion.prior_training.random_occluders import half_plane
from occfusion.prior_training.silhouette_examples import draw_poses
from occfusion.priors.embedded.silhouette_prior import EmbeddedScore
from occfusion.settings.stages import SdsSettings
from occfusion.splat import rasterize
from occfusion.stages.distil import Distiller
from occfusion.synth.dress import dress
from occfusion.synth.fullbody import bone_transforms, load_full_body, skin
from occfusion.synth.subject import make_subject
from occfusion.types import Camera, Frame, Pose

SIZE, FRAMES, STEPS = 160, 12, 600
SUBJECT = 17  # one of those the prior is trained with, in poses that it is not
FAINT = -4.0
PLANTED = 150


@dataclass(frozen=True)
class Shot:
    """A frame, what the person really covers, and what is hidden."""

    frame: Frame
    whole: Tensor
    hidden: Tensor


def make_shots() -> list[Shot]:
    rng = np.random.default_rng(SUBJECT)
    subject = make_subject(SUBJECT)
    figure = dress(subject)
    shots = []
    for index, angles in enumerate(draw_poses(FRAMES, subject.betas, rng, held_out=True)):
        turned = np.concatenate([np.zeros(3), angles[3:]])
        transforms = bone_transforms(turned, figure.joints, load_full_body().parents)
        person = skin(figure.rest, figure.weights, transforms)
        middle = 0.5 * (person.min(axis=0) + person.max(axis=0))
        eye = middle + np.array([1.0, 0.3, 3.5])
        viewmat = look_at(torch.tensor(eye), torch.tensor(middle), torch.tensor([0.0, 1.0, 0.0]).double())
        K = torch.tensor([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1.0]]).double()
        seen = view_body(*project_vertices(person, viewmat.numpy(), K.numpy()), figure.faces, SIZE, SIZE)
        whole = seen.coverage > 0.5
        columns = np.nonzero(whole)[1]
        hidden = half_plane(SIZE, np.array([columns.mean(), 0.0]), 0.0)
        visible = torch.from_numpy(whole & ~hidden)
        betas, root, body_pose = (
            torch.tensor(part, dtype=torch.float32) for part in (subject.betas, turned[:3], turned[3:])
        )
        pose = Pose(betas, root, body_pose, torch.zeros(3))
        camera = Camera(viewmat.float(), K.float(), SIZE, SIZE)
        rgb = torch.zeros(SIZE, SIZE, 3)
        frame = Frame(index, 0, f"frame {index}", rgb, visible, None, None, None, camera, pose)
        shots.append(Shot(frame, torch.from_numpy(whole), torch.from_numpy(hidden)))
    return shots


def stand_out(points: Tensor, body: Body) -> Tensor:
    """Returns which points lie beside the canonical body, not over it, from a third of the directions or more."""
    beside = torch.zeros(len(points))
    for turn in range(CANONICAL_ANGLES):
        view = view_canonical(body, turn, 128)
        pixels, _ = project_vertices(
            points.double().numpy(), view.camera.viewmat.numpy(), view.camera.K.numpy()
        )
        columns, rows = np.clip(pixels.astype(int), 0, 127).T
        beside += torch.from_numpy(view.body().coverage[rows, columns] == 0.0)
    return beside >= CANONICAL_ANGLES / 3


def make_avatar(body: Body) -> tuple[Avatar, int]:
    """Returns faint Gaussians on the body and half opaque ones beside it, and how many the first are."""
    own = Gaussians.on_body(body, 0)
    generator = torch.Generator().manual_seed(0)
    start = own.means.detach()
    around = torch.nn.functional.normalize(torch.randn(PLANTED, 3, generator=generator), dim=1)
    around *= 0.10 + 0.15 * torch.rand(PLANTED, 1, generator=generator)
    beside = start[torch.randint(len(start), (PLANTED,), generator=generator)] + around
    beside = beside[torch.cdist(beside, start).amin(dim=1) > 0.08]
    beside = beside[stand_out(beside, body)]
    scales = torch.cat([own.scales.detach(), torch.full((len(beside), 3), 0.02)])
    gaussians = Gaussians(torch.cat([start, beside]), scales, 0)
    with torch.no_grad():
        gaussians.opacity_logits[: len(start)] = FAINT
        gaussians.opacity_logits[len(start) :] = 0.0
    avatar = Avatar(body, sh_degree=0, refine_pose=False, learn_skinning=False, gaussians=gaussians)
    avatar.refresh_vertex_index()
    return avatar.train(), len(start)


def alpha_of(avatar: Avatar, frame: Frame) -> Tensor:
    cloud, camera = avatar(frame.pose, frame.camera.centre), frame.camera
    return rasterize(
        cloud.means, None, None, cloud.opacities, cloud.colors, camera.viewmat, camera.K, SIZE, SIZE,
        covariances=cloud.covariances,
    ).alpha  # fmt: skip


def fitted(
    settings: SdsSettings | None, steps: int = STEPS, weights: str | None = None
) -> tuple[float, float]:
    """Returns the mean IoU inside the hidden half, and the floaters' mean opacity."""
    body, shots = embedded_body(), make_shots()
    observed_frames = observe_frames(lambda k: shots[k].frame, range(len(shots)), body)
    avatar, count = make_avatar(body)
    distiller = None
    if settings is not None:
        prior = EmbeddedScore(weights)
        distiller = Distiller(
            prior,
            settings,
            steps=steps,
            observed_frames=observed_frames,
            body=body,
            renderer=Renderer("auto"),
            seed=0,
        )
    rates = {"means": 1.6e-4, "sh0": 0.0, "opacity": 5e-2, "scales": 5e-3, "quats": 1e-3}
    adam = torch.optim.Adam(avatar.parameter_groups(rates), eps=1e-15)
    for step in range(steps):
        avatar.prepare(step)
        frame = shots[step % FRAMES].frame
        known = frame.visible_mask | torch.from_numpy(observed_frames[frame.index].evidence.background)
        alpha = alpha_of(avatar, frame)
        loss = 2e4 * torch.where(known, (alpha - frame.visible_mask.float()).square(), 0.0).mean()
        if distiller is not None:
            for name, term in distiller.terms(avatar, frame, alpha, (0, 0, SIZE, SIZE), step).items():
                loss = loss + distiller.weight(name) * term
        adam.zero_grad()
        loss.backward()
        adam.step()
    scores = []
    with torch.no_grad():
        for shot in shots:
            found = (alpha_of(avatar, shot.frame) > 0.5) & shot.hidden
            truth = shot.whole & shot.hidden
            scores.append(float((found & truth).sum() / (found | truth).sum()))
    return float(np.mean(scores)), float(avatar.gaussians.opacities[count:].detach().mean())


@pytest.mark.slow
def test_hidden_half_comes_back_and_floaters_go() -> None:
    without, _ = fitted(None)
    assert without < 0.55
    overlap, opacity = fitted(SdsSettings(lambda_pose=1e5, lambda_can=1e5))
    assert overlap >= 0.85
    assert opacity <= 0.05
