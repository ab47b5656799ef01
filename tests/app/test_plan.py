"""What the plan leaves out, decided on made-up frames."""

from dataclasses import replace

import numpy as np
import pytest

from app.test_config import settings_of
from occfusion.geometry.coverage import Coverage
from occfusion.human.coverage import BodyCoverage
from occfusion.human.observability import Observability, ObservedSurface
from occfusion.observation.consistency import ProjectedMesh
from occfusion.observation.evidence import HIDDEN_SHARE, Evidence
from occfusion.observation.exposure import Exposure, Gains
from occfusion.observation.frames import ObservedFrame, ObservedFrames, PosedBody
from occfusion.observation.key_light import KeyLight
from occfusion.observation.light import Light
from occfusion.observation.pose_alignment import Alignment
from occfusion.plan import make as planning
from occfusion.plan.decisions import box_reason
from occfusion.plan.hidden import with_everything
from occfusion.settings.schema import Settings, optim_hash

SUMMARY = {"occluded_frames": 0, "frames": 12, "frames_unseen": 0}


def frames(*shares: float) -> ObservedFrames:
    """Returns frames of 100 x 50 px that hide these shares of a body in the middle, 20 x 24 px large."""
    nothing = np.zeros((50, 100), dtype=bool)
    motion = ProjectedMesh(np.array([[40.0, 10.0], [60.0, 34.0]]), np.ones(2))
    keypoints = np.zeros((18, 3))
    return ObservedFrames.of(
        [
            ObservedFrame(
                k,
                lambda: PosedBody(np.zeros((2, 3)), keypoints, motion),
                Evidence(nothing, nothing, nothing, share, share > HIDDEN_SHARE, share),
            )
            for k, share in enumerate(shares)
        ]
    )


LIGHT = Light(KeyLight(np.array([0.1, -0.2, 0.1]), 0.04, 0.02, 5.0), 0.1)


def made(settings: Settings, observed_frames: ObservedFrames | None) -> planning.Plan:
    return planning.make_plan(settings, SUMMARY, "torch", observed_frames, LIGHT)


def used(settings: Settings, observed_frames: ObservedFrames | None) -> dict[str, bool]:
    return {d.part: d.used for d in made(settings, observed_frames).decisions}


def alignment_of(amount: float) -> Alignment:
    nothing, places, spreads = np.zeros((4, 24, 3)), np.zeros((4, 3)), {"root": 0.01, "place": 0.01}
    return Alignment(
        nothing, places, spreads, amount, 0.3, nothing, 0.0, 4.0, np.zeros(3), np.ones(3), 0.2, 0.8
    )


def as_planned(settings: Settings, observed_frames: ObservedFrames | None) -> Settings:
    """The settings that training goes by."""
    return made(settings, observed_frames).settings


@pytest.mark.parametrize(
    ("overrides", "shares", "mended"),
    [
        ((), [0.0] * 12, False),
        ((), [0.0] * 5 + [0.02] * 7, True),
        ((), [0.0] * 8 + [0.02] * 4, False),  # some hide a little
        ((), [0.0] * 9, True),  # too few to tell
        ((), [0.0] * 11 + [0.5], False),  # the frame that hides much says nothing about poses
        ((), [0.0] * 9 + [0.5] * 3, True),  # too few whole ones to tell
        ((), [0.0] * 5 + [0.02] * 6 + [0.5], True),
        (("plan=full",), [0.0] * 12, True),
        (("variant=D",), [0.0] * 12, False),
        (("variant=A",), [0.0] * 12, False),
        (("variant=A",), [0.02] * 12, True),
        (("variant=gauhuman", "optim.pose_knots=4"), [0.0] * 12, False),
        (("variant=gauhuman", "recipe=paper", "optim.pose_knots=4"), [0.0] * 12, True),
        (("optim.refine_pose=false", "optim.learn_skinning=false", "optim.pose_knots=0"), [0.02] * 12, False),
    ],
)
def test_networks_mend_poses_that_do_not_fit(
    overrides: tuple[str, ...], shares: list[float], mended: bool
) -> None:
    settings, observed_frames = settings_of(*overrides), frames(*shares)
    plan = used(settings, observed_frames)
    parts = ("pose refinement", "pose corrections frame by frame", "skinning network")
    assert all(plan[part] == mended for part in parts)
    planned = as_planned(settings, observed_frames).optim
    assert planned.refine_pose == (planned.pose_knots > 0) == planned.learn_skinning == mended


def test_the_plain_baseline_corrects_no_frame_by_itself() -> None:
    settings = settings_of("variant=gauhuman", "recipe=paper")
    assert settings.optim.pose_knots == 0
    assert not used(settings, frames(*[0.02] * 12))["pose corrections frame by frame"]


@pytest.mark.parametrize(
    ("overrides", "shares", "distilled"),
    [
        ((), [0.0] * 4 + [0.5] * 8, False),
        ((), [0.0] * 4 + [0.5] * 7 + [0.95], False),
        ((), [0.0] * 4 + [0.5] * 3 + [0.95] * 5, True),
        (("variant=D",), [0.0] * 4 + [0.5] * 8, True),
        (("variant=D",), [0.0] * 12, False),
        (("plan=full",), [0.0] * 4 + [0.5] * 8, True),
    ],
)
def test_distillation_where_masks_are_complete(
    overrides: tuple[str, ...], shares: list[float], distilled: bool
) -> None:
    settings, observed_frames = settings_of(*overrides, "optim.sds.where=everywhere"), frames(*shares)
    plan = used(settings, observed_frames)
    assert plan["loss term sds_pose"] == plan["loss term sds_can"] == distilled
    assert as_planned(settings, observed_frames).optim.sds.is_used == distilled


def test_what_is_left_out_does_not_keep_results_apart() -> None:
    """`E` optimises what `D` does if asked for everything, without distillation what `B` does: it may take that."""
    observed_frames = frames(*[0.5] * 12)
    flat = ("optim.thickness=0", "optim.observed_colors=false", "optim.rates.scales=0.05")
    plain = ("optim.key_light=false", "optim.dilation=0.3", *flat)
    whole, distilled = (
        as_planned(settings_of(f"variant={v}", "plan=full", *plain), observed_frames) for v in "ED"
    )
    assert optim_hash(whole) == optim_hash(distilled)
    lit, sharp = (
        ("optim.key_light=true", "optim.observed_colors=true"),
        ("optim.thickness=0.002", "optim.dilation=0.1"),
    )
    for own in (*lit, *sharp):
        settings = settings_of("variant=E", "plan=full", *plain, own)
        assert optim_hash(whole) != optim_hash(as_planned(settings, observed_frames))
    alike = ("refine.lambda_lpips=0", "refine.hidden.target=complete", "refine.densify=false", *plain)
    needed, masks = (as_planned(settings_of(f"variant={v}", *alike), observed_frames) for v in "EB")
    assert optim_hash(needed) == optim_hash(masks)
    assert optim_hash(needed) != optim_hash(settings_of("variant=E"))
    deferred = as_planned(
        settings_of("variant=E"), observed_frames
    )  # its perceptual term comes in the refinement
    assert optim_hash(deferred) != optim_hash(masks)


def test_the_share_of_the_picture_is_measured() -> None:
    (reason,) = (
        d.reason
        for d in made(settings_of(), frames(*[0.0] * 3)).decisions
        if d.part.startswith("pixels outside")
    )
    # the body's 20 x 24 px and 8 more on each side, of 100 x 50
    assert f"{36 * 40 / 5000:.0%}" in reason
    assert "rendered crops" in box_reason(None)


@pytest.mark.parametrize(
    ("overrides", "built"),
    [
        ((), False),
        (("stage=optim",), False),  # the refinement comes later
        (("plan=full",), True),
        (("variant=B",), True),
        (("variant=D",), True),
        (("refine.lambda_lpips=0",), True),
        (("optim.lambda_lpips=0",), False),
    ],
)
@pytest.mark.parametrize("observed_frames", [frames(*[0.0] * 12), frames(*[0.0] * 4, *[0.5] * 8)])
def test_the_optimisation_leaves_its_perceptual_term_to_the_refinement(
    overrides: tuple[str, ...], built: bool, observed_frames: ObservedFrames
) -> None:
    settings = settings_of(*overrides)
    assert used(settings, observed_frames)["loss term lpips"] == built
    assert (as_planned(settings, observed_frames).optim.lambda_lpips > 0) == built


@pytest.mark.parametrize(
    ("overrides", "gaussians"),
    [
        ((), 0),
        (("stage=optim",), 0),
        (("plan=full",), 20_000),
        (("refine.densify=false",), 20_000),
        (("variant=A",), 20_000),
        (("variant=D", "optim.gaussians=9000"), 9000),
        (("variant=gauhuman",), 0),
    ],
)
def test_the_whole_system_leaves_gaussians_between_vertices_to_its_refinement(
    overrides: tuple[str, ...], gaussians: int
) -> None:
    settings = settings_of(*overrides)
    observed_frames = frames(*[0.5] * 8, *[0.0] * 4)
    assert as_planned(settings, observed_frames).optim.gaussians == gaussians
    part = "Gaussians between the body's vertices at the start"
    assert used(settings, observed_frames)[part] == (gaussians > 0)


def test_the_whole_system_counts_hidden_masks_as_its_refinement_does() -> None:
    occluded = frames(*[0.5] * 8, *[0.0] * 4)
    for variant, plan, weight in (
        ("E", "needed", 0.0),
        ("E", "full", 1.0),
        ("B", "needed", 1.0),
        ("D", "needed", 1.0),
    ):
        settings = settings_of(f"variant={variant}", f"plan={plan}")
        assert as_planned(settings, occluded).optim.hidden.weight == weight
        assert used(settings, occluded)["full mask term on hidden pixels"] == (weight == 1.0)
    complete = "refine.hidden.target=complete"
    fitting = frames(*[0.5] * 8, *[0.0] * 12)  # enough whole people to see that their poses fit
    for overrides, weights in (
        ((), (0.2, 0.1)),  # in the refinement what is hidden is held to the avatar's own outline
        (("refine.hidden.target=outline", "refine.hidden.weight=0.5"), (0.2, 0.5)),
        ((complete, "refine.hidden.weight=0.2"), (0.2, 0.2)),
        ((complete,), (1.0, 1.0)),
        ((complete, "refine.hidden.weight=0.5"), (0.5, 0.5)),
        (("refine.hidden.target=none",), (0.0, 0.0)),
        ((complete, "refine.hidden.weight=0.2", "variant=B"), (1.0, 0.2)),
    ):
        planned = as_planned(settings_of(*overrides), fitting)
        assert (planned.optim.hidden.weight, planned.refine.hidden.weight) == weights
    mended = frames(*[0.5] * 8, *[0.02] * 12)
    assert as_planned(settings_of(), mended).refine.hidden.weight == 0.0
    assert as_planned(settings_of("plan=full"), mended).refine.hidden.weight == 1.0
    assert as_planned(settings_of(complete, "plan=full"), mended).refine.hidden.weight == 1.0
    halves = [f"{stage}.hidden.target=complete" for stage in ("optim", "refine")]
    weighed = settings_of(*halves, "refine.hidden.weight=0.5", "optim.hidden.weight=0.25")
    assert as_planned(weighed, occluded).optim.hidden.weight == 0.25
    for amount in (0.75, 0.0):  # where outlines do not say that poses are off, nothing mends them either
        aligned = planning.make_plan(
            settings_of(), SUMMARY, "torch", mended, alignment=alignment_of(amount)
        ).settings
        assert (aligned.optim.hidden.weight, aligned.refine.hidden.weight) == (0.2, 0.1)
        assert aligned.refine.hidden.target == "outline"
    assert not used(settings_of("variant=B"), frames(*[0.0] * 12))["full mask term on hidden pixels"]


@pytest.mark.parametrize(
    ("overrides", "most"),
    [
        ((), 5),
        (("init.max_frames=8",), None),  # all that are occluded
        (("init.max_frames=null",), None),
        (("plan=full",), None),
        (("stage=init",), None),  # they are what was asked for
        (("variant=B",), None),  # no refinement makes up for it: complete masks count fully
        (("optim.hidden.target=complete",), None),
        (("refine.hidden.target=complete",), None),
        (("refine.hidden.target=complete", "refine.hidden.weight=0.5"), None),
        (("refine.hidden.target=outline", "refine.hidden.weight=0.5"), 5),
        (("refine.references.source=prior",), None),  # it is given complete masks
    ],
)
def test_of_many_occluded_frames_some_get_masks_where_these_count_for_little(
    overrides: tuple[str, ...], most: int | None
) -> None:
    observed_frames = frames(*[0.5] * 8, *[0.0] * 12)
    plan = made(settings_of("init.max_frames=5", *overrides), observed_frames)
    every = made(settings_of("init.max_frames=null", *overrides), observed_frames).settings
    assert plan.settings.init.max_frames == most
    # each counts for those that are not made
    assert plan.settings.optim.hidden.weight == pytest.approx(
        every.optim.hidden.weight * (8 / 5 if most else 1)
    )
    assert plan.settings.refine.hidden == every.refine.hidden
    (decision,) = (d for d in plan.decisions if d.part == "complete masks")
    assert decision.used and ("; 5 of 8 are completed" in decision.reason) == (most is not None)


@pytest.mark.parametrize(("most", "planned"), [(12, 12), (20, None)])
def test_of_a_long_video_some_frames_stand_for_all(most: int, planned: int | None) -> None:
    """Every second of 36 frames is looked at, the others would hide as much: 16 of all are occluded, by 8 of 18."""
    looked: list[int] = []
    some = frames(*[0.5] * 8, *[0.0] * 10)

    def look(position: int) -> ObservedFrame:
        looked.append(position)
        return some[position // 2]

    observed_frames = ObservedFrames(range(36), look, range(0, 36, 2))
    plan = made(settings_of(f"init.max_frames={most}"), observed_frames)
    assert plan.settings.init.max_frames == planned
    (decision,) = (d for d in plan.decisions if d.part == "complete masks")
    assert decision.reason.startswith("8 of 18 training frames, evenly spread, hide more than 3% of the body")
    assert ("; 12 of about 16 are completed" in decision.reason) == (planned is not None)
    every = made(settings_of("init.max_frames=null"), observed_frames).settings.optim.hidden.weight
    weight = plan.settings.optim.hidden.weight
    assert weight == pytest.approx(every * (16 / 12 if planned else 1))
    assert sorted(looked) == list(range(0, 36, 2))


def test_no_mask_counts_for_more_than_was_tried() -> None:
    observed_frames = frames(*[0.5] * 30, *[0.0] * 12)
    assert as_planned(settings_of("init.max_frames=3"), observed_frames).optim.hidden.weight == 0.8
    mended = frames(*[0.5] * 30, *[0.02] * 12)
    assert as_planned(settings_of("init.max_frames=3"), mended).optim.hidden.weight == 0.0


def test_a_full_plan_says_what_the_frames_hide_and_that_it_takes_all_for_occluded() -> None:
    observed_frames = with_everything(frames(*[0.0] * 9, *[0.5] * 3))
    plan = made(settings_of("plan=full"), observed_frames)
    (reason,) = (d.reason for d in plan.decisions if d.part == "complete masks")
    assert reason.startswith("3 of 12 training frames hide more than 3%")
    assert "takes all of them" in reason


def light_of(disagreement: float = 0.1, condition: float = 5.0) -> Light:
    return Light(KeyLight(np.array([0.1, -0.2, 0.1]), 0.04, 0.038, condition), disagreement)


@pytest.mark.parametrize(
    ("overrides", "found", "lit"),
    [
        ((), light_of(), True),
        ((), light_of(disagreement=0.9), False),  # two halves of the body tell of different ones
        ((), light_of(disagreement=float("inf")), False),  # one tells of none
        ((), light_of(condition=500.0), False),  # it may be anywhere
        ((), Light(), False),
        ((), None, False),
        (("plan=full",), light_of(disagreement=0.9), True),
        (("plan=full",), light_of(condition=500.0), False),
        (("variant=D",), None, False),
        (("variant=D",), light_of(), True),
        (("variant=D", "optim.key_light=false"), light_of(), False),
        (("recipe=paper",), light_of(), False),
    ],
)
def test_a_lamp_is_used_where_the_video_tells_where_it_is(
    overrides: tuple[str, ...], found: Light | None, lit: bool
) -> None:
    plan = planning.make_plan(settings_of(*overrides), SUMMARY, "torch", frames(*[0.0] * 12), found)
    (decision,) = (d for d in plan.decisions if d.part == "key light")
    assert decision.used == lit == plan.settings.optim.key_light
    asked = settings_of(*overrides).optim.key_light
    lamp = None if found is None else found.key_light
    assert lamp is None or not asked or f"{lamp.explained:.0%}" in decision.reason


def exposed(explained: float) -> Light:
    nothing = np.zeros(0, np.int64)
    exposure = Exposure(
        Gains(nothing, np.zeros((0, 3)), nothing, np.zeros((0, 3)), 0.01, np.zeros(3)),
        np.ones(3),
        0.05,
        explained,
    )
    return Light(exposure=exposure, gains=np.ones((12, 3)) if exposure.is_taken else None)


@pytest.mark.parametrize(
    ("overrides", "found", "evened", "told"),
    [
        ((), exposed(0.3), True, "30%"),
        ((), exposed(0.1), False, "10%"),
        ((), Light(), False, "too little"),
        (("exposure=off",), None, False, "off"),
        (("recipe=paper",), None, False, "off"),
    ],
)
def test_pictures_are_evened_where_exposure_wanders(
    overrides: tuple[str, ...], found: Light | None, evened: bool, told: str
) -> None:
    plan = planning.make_plan(settings_of(*overrides), SUMMARY, "torch", frames(*[0.0] * 12), found)
    (decision,) = (d for d in plan.decisions if d.part == "evened exposure")
    assert decision.used == evened and told in decision.reason


def test_variants_differ_by_their_stages_and_terms_alone() -> None:
    """`A` to `E` have the same numbers, of either recipe; what differs is in Table 2."""
    for recipe in ("ours", "paper"):
        base = settings_of("variant=E", f"recipe={recipe}")
        for variant in "ABCD":
            settings = settings_of(f"variant={variant}", f"recipe={recipe}")
            assert settings.refine == base.refine and settings.init == base.init
            assert replace(settings.optim, sds=base.optim.sds) == base.optim, (variant, recipe)


def test_the_papers_recipe_leaves_nothing_out_and_adds_nothing() -> None:
    settings = settings_of("recipe=paper")
    optim, refine = settings.optim, settings.refine
    assert settings.plan == "full" and settings.output_dir.endswith("/E-paper")
    assert (optim.dilation, optim.thickness, optim.observed_colors, optim.key_light) == (
        0.3,
        0.0,
        False,
        False,
    )
    assert (optim.gaussians, optim.pose_knots, optim.rates.scales, optim.rates.pose) == (0, 0, 5e-3, 5e-5)
    assert optim.perceptual_every == refine.perceptual_every == 1
    assert (refine.lambda_rgb, refine.lambda_mask, refine.references.weight, refine.lambda_lpips) == (
        1.0,
        0.1,
        0.1,
        0.2,
    )
    assert (optim.sds.lambda_pose, optim.sds.lambda_can) == (2e5, 2e5)
    observed_frames = with_everything(frames(*[0.0] * 9, *[0.5] * 3))
    parts = used(settings, observed_frames)
    for part in ("complete masks", "inpainting", "loss term sds_pose", "pose refinement", "skinning network"):
        assert parts[part], part
    assert settings_of("recipe=paper", "plan=needed").plan == "needed"


@pytest.mark.parametrize(
    ("overrides", "rounds"),
    [
        ((), [100, 200, 300, 400, 500]),
        (("optim.steps=1800",), [100, 200, 300, 400, 500]),  # its own steps count, whatever came before
        (("speed=fast",), [200, 400]),
        (("speed=best",), [200, 400, 600, 800, 1000]),
        (("refine=paper",), [200, 400, 600, 800, 1000]),
        (("trainer.max_steps=300",), [100, 200]),
        (("trainer.max_steps=100",), []),
        (("refine.densification.after_step=600",), []),
    ],
)
def test_a_schedule_that_never_fires_is_named(overrides: tuple[str, ...], rounds: list[int]) -> None:
    plan = made(settings_of(*overrides), frames(*[0.5] * 8, *[0.0] * 4))
    (decision,) = (d for d in plan.decisions if d.part == "densification in the refinement")
    assert decision.used == bool(rounds) == plan.settings.refine.densify
    told = f"rounds at steps {', '.join(map(str, rounds))} of" if rounds else "no round falls into"
    assert told in decision.reason


def test_the_plan_is_told_in_a_few_lines() -> None:
    lines = made(settings_of(), frames(*[0.5] * 8, *[0.0] * 12)).lines()
    assert lines[0] == "stages: init, optim, refine" and 3 <= len(lines) <= 6
    assert any(line.startswith("pose refinement: no; ") for line in lines)


def surface_of(turn: float) -> ObservedSurface:
    nothing = np.zeros((2, 3, 3))
    places = np.zeros(2)
    known = Observability(nothing, nothing, np.zeros((2, 3)), places, places, places > 0)
    return ObservedSurface(known, 0.8, turn, places)


def planned_for(surface: ObservedSurface | None, *overrides: str) -> planning.Plan:
    return planning.make_plan(
        settings_of(*overrides), SUMMARY, "torch", frames(*[0.0] * 12), LIGHT, surface=surface
    )


@pytest.mark.parametrize(
    ("overrides", "turn", "closes"),
    [
        ((), 12.0, True),
        ((), 42.0, False),  # turns round
        ((), None, False),  # the body is in no frame
        (("plan=full",), 42.0, True),
        (("recipe=paper",), 12.0, False),
    ],
)
def test_the_surface_is_closed_where_the_video_leaves_it_open(overrides, turn, closes):
    plan = planned_for(None if turn is None else surface_of(turn), *overrides)
    found = {d.part: d.used for d in plan.decisions}
    assert found["surface prior"] is found["surface prior in refine"] is closes
    assert plan.settings.optim.surface.is_used is plan.settings.refine.surface.is_used is closes
    assert any(line.startswith("surface prior: ") for line in plan.lines())


def test_weights_of_one_stage_say_nothing_of_the_other():
    off = [f"optim.surface.{name}=0" for name in ("outline", "backface")]
    off.append("optim.surface.hold=false")
    plan = planned_for(surface_of(12.0), *off)
    assert not plan.settings.optim.surface.is_used and plan.settings.refine.surface.is_used
    assert optim_hash(plan.settings) != optim_hash(planned_for(surface_of(12.0)).settings)


def covered(unseen: float) -> BodyCoverage:
    """A body of two halves by area, of which so much is not seen."""
    looks = np.array([10.0, 0.0])
    spread, moments = np.array([40.0, np.nan]), np.zeros((2, 3, 3))
    return BodyCoverage(
        Coverage(10, looks, spread, moments, moments),
        np.array(["back", "back"]),
        np.array([1.0 - unseen, unseen]),
    )


@pytest.mark.parametrize(
    ("overrides", "unseen", "completes"),
    [
        ((), 0.07, False),  # turns round
        ((), 0.4, True),
        ((), None, False),  # the body is in no frame
        (("optim.unseen_colors=prior",), 0.07, True),
        (("optim.unseen_colors=nearest",), 0.4, False),
        (("plan=full",), 0.07, True),
        (("recipe=paper",), 0.4, False),
    ],
)
def test_colours_are_completed_where_much_of_the_body_is_unseen(overrides, unseen, completes):
    coverage = None if unseen is None else covered(unseen)
    plan = planning.make_plan(
        settings_of(*overrides), SUMMARY, "torch", frames(*[0.0] * 12), LIGHT, coverage=coverage
    )
    assert {d.part: d.used for d in plan.decisions}["completed colours"] is completes
    assert (plan.settings.optim.unseen_colors == "prior") is completes
    assert any(line.startswith("completed colours: ") for line in plan.lines()) is completes


@pytest.mark.parametrize(
    ("overrides", "source"),
    [
        ((), "coarse"),
        (("prior=sd15",), "prior"),
        (("refine.references.pixels=hidden",), "prior"),
        (("refine.references.source=prior",), "prior"),
        (("refine.references.source=truth",), "truth"),
        (("plan=full",), "prior"),
        (("plan=full", "refine.references.source=coarse"), "coarse"),
        (("recipe=paper",), "prior"),
    ],
)
def test_a_prior_paints_references_where_they_count_in_all_that_is_hidden(overrides, source):
    plan = made(settings_of(*overrides), frames(*[0.5] * 12))
    assert plan.settings.refine.references.source == source
    (decision,) = (d for d in plan.decisions if d.part == "references painted by a prior")
    assert decision.used is (source == "prior")


def test_no_prior_paints_where_nothing_is_hidden():
    plan = made(settings_of("refine.references.pixels=hidden"), frames(*[0.0] * 12))
    (decision,) = (d for d in plan.decisions if d.part == "references painted by a prior")
    assert not decision.used and "no frame is inpainted" in decision.reason


def test_the_perceptual_term_of_the_refinement_begins_at_half_of_its_steps() -> None:
    asked, hidden = settings_of(), frames(*[0.5] * 12)
    assert asked.refine.first_perceptual_step == 464  # the first of every sixteenth from the middle on
    plan = planning.make_plan(asked, SUMMARY, "torch", hidden)
    decisions = {d.part: d for d in plan.decisions}
    schedule = decisions["perceptual term at every step and on the whole person in refine"]
    assert not schedule.used and "from step 464 of 900 on" in schedule.reason
    assert plan.settings.refine.lambda_lpips and not plan.settings.optim.lambda_lpips
    assert used(settings_of("recipe=paper"), None)[
        "perceptual term at every step and on the whole person in refine"
    ]


def test_a_perceptual_term_that_is_never_due_is_left_out() -> None:
    plan = planning.make_plan(settings_of("trainer.max_steps=464"), SUMMARY, "torch", frames(*[0.5] * 12))
    term = {d.part: d for d in plan.decisions}["loss term lpips in refine"]
    assert (
        not term.used and "refine.perceptual_from = 0.5 begins at step 464, and 464 are taken" in term.reason
    )
    assert not plan.settings.refine.lambda_lpips
    assert plan.settings.optim.lambda_lpips == 1e3
    longer = planning.make_plan(settings_of("trainer.max_steps=657"), SUMMARY, "torch", frames(*[0.5] * 12))
    assert longer.settings.refine.lambda_lpips == 0.1
