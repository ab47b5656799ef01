"""The loss terms of the refinement: which pixels each of them looks at."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from made_up_partial import made_up_partial
from occfusion.files.atomic import write_png
from occfusion.files.run_folder import RunFolder
from occfusion.human import embedded_body
from occfusion.human.avatar import Avatar
from occfusion.human.rendering import Renderer
from occfusion.inpaint.partial import KNOWN
from occfusion.observation.evidence import Evidence
from occfusion.observation.frames import ObservedFrame, ObservedFrames
from occfusion.quality import losses
from occfusion.settings.stages import HiddenSettings, ReferenceSettings, RefineSettings
from occfusion.stages.references import References
from occfusion.stages.refine import RefineStage
from occfusion.stages.targets import Masks, UncertainMasks
from occfusion.types import Frame, Pose, Rendering

SIZE = 32
BOX = (0, 0, SIZE, SIZE)
SEEN, PAINTED, ELSEWHERE, UNASKED = (
    (slice(4, 28), slice(4, 14)),
    (slice(4, 28), slice(14, 24)),
    (slice(4, 28), slice(24, 30)),
    (slice(28, 30), slice(4, 30)),
)


def mask_of(place: tuple[slice, slice]) -> Tensor:
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[place] = True
    return mask


@pytest.fixture
def frame() -> Frame:
    """A red person, seen in `SEEN`; complete with `PAINTED`."""
    seen = mask_of(SEEN)
    rgb = seen[..., None] * torch.tensor([0.8, 0.1, 0.1])
    camera = made_up_partial(SIZE).observation.camera
    pose = Pose(torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.zeros(3))
    return Frame(7, 0, "frame", rgb, seen, None, seen | mask_of(PAINTED), None, camera, pose)


@pytest.fixture
def references(tmp_path: Path) -> References:
    """The same person, painted green where it is not seen."""
    region = mask_of(PAINTED).numpy()
    picture = np.zeros((SIZE, SIZE, 3), np.uint8)
    picture[SEEN], picture[PAINTED] = (204, 26, 26), (0, 255, 0)
    folder = RunFolder(tmp_path).inpainted
    write_png(folder.picture(7), picture)
    write_png(folder.second_picture(7), np.where(region, 255, 0).astype(np.uint8))
    return References(folder, frozenset({7}))


def stage_of(
    references: References, outlines: Masks | None = None, hidden: float = 0.0, **counted: Any
) -> RefineStage:
    """A stage that uncertain all of frame 7 but what is seen and `ELSEWHERE`, and whose other settings cost nothing.

    Args:
        references: inpainted frames.
        outlines: the avatar's own.
        hidden: weight of what is uncertain.
        counted: how references count.
    """
    chosen = RefineSettings(
        lambda_lpips=0.0,
        densify=False,
        hidden=HiddenSettings("outline" if outlines else "complete", hidden),
        references=ReferenceSettings(**counted),
    )
    uncertain = UncertainMasks(
        {7: (~mask_of(SEEN) & ~mask_of(ELSEWHERE)).numpy()}, {7: mask_of(UNASKED).numpy()}
    )
    return RefineStage(
        Avatar(embedded_body()), chosen, references, uncertain, outlines or {}, perceptual=None,
        densifier=None, renderer=Renderer("torch"), seed=0, steps_before=0,
    )  # fmt: skip


def gradients(frame: Frame, references: References, *, perceptual: bool) -> dict[str, Tensor]:
    """Returns where each term's gradient by the rendered colours is not zero."""
    stage = stage_of(references, perceptual=perceptual)
    rgb = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    alpha = torch.full((SIZE, SIZE), 0.5)
    rendering = Rendering(rgb, alpha, torch.zeros(SIZE, SIZE), torch.zeros(0, 2))
    found = {}
    for name, term in stage.terms(frame, rendering, BOX).items():
        if term.requires_grad:
            found[name] = torch.autograd.grad(term, rgb, retain_graph=True)[0].abs().sum(dim=2) > 0
    return found


def test_each_term_looks_at_its_own_pixels(frame: Frame, references: References) -> None:
    found = gradients(frame, references, perceptual=False)
    seen, painted = mask_of(SEEN), mask_of(PAINTED)
    assert torch.equal(found["rgb"], seen)
    assert torch.equal(found["gen"], painted)
    off_the_edge = losses.within(seen, RefineSettings().ssim_margin)
    assert not torch.equal(off_the_edge, seen)
    assert found["ssim"][off_the_edge].all() and not found["ssim"][~off_the_edge].any()


def test_with_all_pixels_ssim_looks_at_the_painted_ones_too(frame: Frame, references: References) -> None:
    looked_at = gradients(frame, references, perceptual=True)["ssim"]
    assert looked_at[losses.within(mask_of(SEEN) | mask_of(PAINTED), RefineSettings().ssim_margin)].all()
    assert not looked_at[mask_of(ELSEWHERE)].any()


def test_a_frame_without_a_reference_has_no_generated_term(frame: Frame, references: References) -> None:
    other = dataclasses.replace(frame, index=8)
    found = gradients(other, references, perceptual=True)
    assert "gen" not in found
    assert not found["ssim"][~mask_of(SEEN)].any()


@pytest.mark.parametrize("pixels", ["unseen", "hidden"])
@pytest.mark.parametrize("hidden", [0.0, 0.25, 1.0])
def test_mask_term_counts_what_is_neither_seen_nor_background_as_asked(
    frame: Frame, references: References, hidden: float, pixels: str
) -> None:
    alpha = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0)).requires_grad_()
    rendering = Rendering(torch.zeros(SIZE, SIZE, 3), alpha, torch.zeros(SIZE, SIZE), torch.zeros(0, 2))
    for index, weight in ((7, hidden), (8, 1.0)):  # nothing is hidden in frame 8
        other = dataclasses.replace(frame, index=index)
        stage = stage_of(references, hidden=hidden, pixels=pixels)
        term = stage.terms(other, rendering, BOX)["mask"]
        (found,) = torch.autograd.grad(term, alpha)
        target = (mask_of(SEEN) | mask_of(PAINTED)).float()
        weights = torch.full((SIZE, SIZE), weight)
        if weight < 1.0:  # no prior was asked about that, so a complete mask says nothing there
            weights[UNASKED] = 0.0
        weights[SEEN] = weights[ELSEWHERE] = 1.0
        if pixels == "unseen":  # no frame shows what was painted: there the complete mask is all there is
            weights[PAINTED] = 1.0
        wanted = sum(
            float(w * (a - t) ** 2)
            for w, a, t in zip(*(x.flatten() for x in (weights, alpha.detach(), target)), strict=True)
        )
        assert float(term) == pytest.approx(wanted / SIZE**2, rel=1e-5)
        torch.testing.assert_close(found, 2 * weights * (alpha - target).detach() / SIZE**2)


@pytest.mark.parametrize("outlined", [False, True])
def test_without_a_complete_mask_nothing_is_held_to_its_absence(
    frame: Frame, references: References, outlined: bool
) -> None:
    """What no frame shows counts fully where a complete mask tells of it, and there alone."""
    frame = dataclasses.replace(frame, complete_mask=None)
    uncertain = ~mask_of(SEEN) & ~mask_of(ELSEWHERE)
    outline = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(1)) > 0.5
    stage = stage_of(references, {7: outline.numpy()} if outlined else None, hidden=0.25, pixels="unseen")
    if not outlined:  # as `UncertainMasks.found` has it of a frame that is given no complete mask
        stage.uncertain = UncertainMasks({7: uncertain.numpy()}, {7: uncertain.numpy()})
    alpha = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    rendering = Rendering(torch.zeros(SIZE, SIZE, 3), alpha, torch.zeros(SIZE, SIZE), torch.zeros(0, 2))
    term = stage.terms(frame, rendering, BOX)["mask"]
    squares = torch.where(
        uncertain, 0.25 * (alpha - outline.float()).square(), (alpha - mask_of(SEEN).float()).square()
    )
    if not outlined:
        squares[uncertain] = 0.0
    assert float(term) == pytest.approx(float(squares.mean()), rel=1e-5)


def test_all_of_a_frame_without_a_complete_mask_is_uncertain() -> None:
    nothing, hidden = np.zeros((4, 6), np.bool_), np.zeros((4, 6), np.bool_)
    hidden[1:3] = True
    background = ~hidden
    background[1] = True
    evidence = Evidence(nothing, background, hidden, 0.5, True, 0.0)
    found = UncertainMasks.found(
        ObservedFrames.of([ObservedFrame(k, lambda: None, evidence) for k in (3, 5)]),  # type: ignore[arg-type,return-value]
        {1},
    )
    assert (found.hidden[3] == hidden).all() and (found.hidden[5] == hidden).all()
    assert (found.assumed_background[3] == hidden).all()
    assert (found.assumed_background[5] == (hidden & background)).all()
    assert list(found.hidden) == [3, 5] and len(found.assumed_background) == 2 and 4 not in found.hidden
    whole = ObservedFrame(7, lambda: None, Evidence(nothing, background, nothing, 0.0, False, 0.0))  # type: ignore[arg-type,return-value]
    certain = UncertainMasks.found(ObservedFrames.of([whole]))
    assert not certain.hidden and certain.hidden.get(7) is None and certain.assumed_background.get(7) is None


@pytest.mark.parametrize("pixels", ["unseen", "hidden"])
@pytest.mark.parametrize("hidden", [0.0, 0.1, 1.0])
def test_mask_term_holds_what_is_in_doubt_to_an_outline(
    frame: Frame, references: References, hidden: float, pixels: str
) -> None:
    outline = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(1)) > 0.5
    alpha = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    rendering = Rendering(torch.zeros(SIZE, SIZE, 3), alpha, torch.zeros(SIZE, SIZE), torch.zeros(0, 2))
    complete = mask_of(SEEN) | mask_of(PAINTED)
    wanted, weights = outline.clone(), torch.full((SIZE, SIZE), hidden)
    wanted[SEEN], wanted[ELSEWHERE] = True, False
    weights[SEEN] = weights[ELSEWHERE] = 1.0
    if pixels == "unseen":
        wanted[PAINTED], weights[PAINTED] = True, 1.0
    # nothing is in doubt in frame 8
    for index, target, counts in ((7, wanted, weights), (8, complete, torch.ones_like(weights))):
        other = dataclasses.replace(frame, index=index)
        outlines = {7: outline.numpy(), 8: outline.numpy()}
        stage = stage_of(references, outlines, hidden=hidden, pixels=pixels)
        term = stage.terms(other, rendering, BOX)["mask"]
        squares = counts * (alpha - target.float()).square()
        assert float(term) == pytest.approx(float(squares.mean()), rel=1e-5)


def test_unseen_is_what_the_video_shows_little_of() -> None:
    partial = made_up_partial()
    half = np.zeros_like(partial.alpha)
    half[: len(half) // 2] = 1.0
    partial = dataclasses.replace(partial, seen=half * partial.alpha)
    assert partial.region[: len(half) // 2].any() and partial.region[len(half) // 2 :].any()
    assert (partial.unseen == (partial.region & (half == 0))).all()
    at_the_limit = dataclasses.replace(partial, seen=np.float32(KNOWN) * partial.alpha)
    assert not at_the_limit.unseen.any()
