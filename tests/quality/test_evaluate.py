from __future__ import annotations

import csv
import dataclasses

import numpy as np
import pytest
import torch

from occfusion.errors import ConfigError
from occfusion.evaluation.evaluate import (
    ImageRow,
    evaluate_frames,
    evaluate_image,
    summarise,
    write_per_image_csv,
)
from occfusion.evaluation.gain import camera_gains, with_gains
from occfusion.geometry.coverage import MANY, ONE, UNSEEN
from occfusion.types import Camera, Frame, Pose, Rendering, Truth
from oracles import quality as oracle
from quality.pictures import noise

HEIGHT, WIDTH = 60, 50
REGIONS = ("full", "box", "visible", "hidden")


def rectangle(rows, columns):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[rows[0] : rows[1], columns[0] : columns[1]] = True
    return mask


PERSON = rectangle((10, 50), (12, 36))
STRIP = rectangle((0, HEIGHT), (20, 30))


def frame(*, occluded=STRIP, person=PERSON, with_truth=True, **changes) -> Frame:
    """A person of noise, and a full-height strip in front of it."""
    rgb = noise(HEIGHT, WIDTH)[0].float() * person[..., None]
    visible = person & ~STRIP
    zeros = torch.zeros(3)
    made = Frame(
        index=7, camera_index=3, name="Camera_B4/000007", rgb=rgb * visible[..., None], visible_mask=visible,
        occluded=occluded, complete_mask=None, truth=Truth(rgb, person) if with_truth else None,
        camera=Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT),
        pose=Pose(torch.zeros(10), zeros, torch.zeros(69), zeros),
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def rendering(alpha=PERSON) -> Rendering:
    """A disturbed copy of the person, also where nobody stands."""
    rgb = noise(HEIGHT, WIDTH)[1].float() * alpha[..., None]
    return Rendering(rgb, alpha.float() * 0.9, alpha.float(), torch.zeros(0, 2))


def by_region(rows):
    return {row.region: row for row in rows}


def exact(region_mask, black_outside):
    """PSNR and SSIM from the oracle over a region, both pictures black outside `black_outside`."""
    truth = noise(HEIGHT, WIDTH)[0].float() * (PERSON & black_outside)[..., None]
    ours = rendering().rgb * black_outside[..., None]
    a, b = ours.double().numpy(), truth.double().numpy()
    return oracle.psnr(a, b, region_mask.numpy()), a, b


def test_full_and_box():
    rows = by_region(evaluate_image(rendering(), frame(), ("full", "box"), None))
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    psnr, a, b = exact(everywhere, everywhere)
    similarity = oracle.ssim_map(a, b)
    assert rows["full"].psnr == pytest.approx(psnr, abs=1e-4)
    assert rows["full"].ssim == pytest.approx(similarity.mean(), abs=1e-6)
    assert rows["full"].pixels == HEIGHT * WIDTH
    # a tenth of 24 x 40 px, rounded up, on each side
    box = (slice(6, 54), slice(9, 39))
    inside = rectangle((6, 54), (9, 39))
    assert rows["box"].pixels == 48 * 30
    assert rows["box"].psnr == pytest.approx(exact(inside, everywhere)[0], abs=1e-4)
    assert rows["box"].ssim == pytest.approx(oracle.ssim_map(a[box], b[box]).mean(), abs=1e-6)
    assert rows["full"].psnr > rows["box"].psnr
    assert rows["full"].mask_iou == rows["box"].mask_iou == 1


@pytest.mark.parametrize(("region", "pixels"), [("visible", PERSON & ~STRIP), ("hidden", PERSON & STRIP)])
def test_visible_and_hidden(region, pixels):
    (row,) = evaluate_image(rendering(), frame(), (region,), None)
    psnr, a, b = exact(pixels, pixels)
    assert row.pixels == int(pixels.sum())
    assert row.psnr == pytest.approx(psnr, abs=1e-4)
    rows, columns = (10, 50), ((12, 36) if region == "visible" else (20, 30))
    padding = [-(-(end - start) // 10) for start, end in (rows, columns)]
    window = tuple(slice(s - p, e + p) for (s, e), p in zip((rows, columns), padding, strict=True))
    expected = oracle.ssim_map(a[window], b[window])[pixels[window].numpy()].mean()
    assert row.ssim == pytest.approx(expected, abs=1e-6)


def test_mask_iou_in_each_region():
    # the rendering lacks the person's left part under the strip and has a floater on the right, not occluded
    alpha = (PERSON & ~rectangle((0, HEIGHT), (20, 25))) | rectangle((20, 30), (45, 49))
    rows = by_region(evaluate_image(rendering(alpha), frame(), REGIONS, None))
    missing, floater = 40 * 5, 10 * 4
    person = 40 * 24
    assert rows["full"].mask_iou == pytest.approx((person - missing) / (person + floater))
    assert rows["box"].mask_iou == pytest.approx((person - missing) / person)
    assert rows["visible"].mask_iou == pytest.approx(40 * 14 / (40 * 14 + floater))
    assert rows["hidden"].mask_iou == pytest.approx(0.5)


def test_the_occluder_decides_what_is_hidden_not_a_ragged_mask():
    ragged = PERSON & ~STRIP & ~rectangle((10, 12), (12, 36))
    (row,) = evaluate_image(rendering(), frame(visible_mask=ragged), ("hidden",), None)
    assert row.pixels == int((PERSON & STRIP).sum())
    (row,) = evaluate_image(rendering(), frame(visible_mask=ragged, occluded=None), ("hidden",), None)
    assert row.pixels == int((PERSON & ~ragged).sum())


def test_what_cannot_be_computed_is_none():
    rows = by_region(evaluate_image(rendering(), frame(with_truth=False, occluded=None), REGIONS, None))
    for region in ("full", "box", "hidden"):
        assert rows[region] == ImageRow(7, 3, region)
    assert rows["visible"].psnr is not None
    assert rows["visible"].mask_iou is None
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    rows = by_region(evaluate_image(rendering(), frame(occluded=nothing), REGIONS, None))
    assert rows["hidden"].pixels == 0 and rows["hidden"].psnr is None
    rows = by_region(
        evaluate_image(rendering(nothing), frame(person=nothing, visible_mask=nothing), REGIONS, None)
    )
    assert rows["full"].psnr == 100 and rows["full"].mask_iou is None
    assert all(rows[region].pixels == 0 for region in ("box", "visible", "hidden"))


def test_a_person_of_one_pixel_in_a_corner():
    dot = rectangle((0, 1), (WIDTH - 1, WIDTH))
    row = by_region(evaluate_image(rendering(), frame(person=dot, visible_mask=dot), REGIONS, None))
    assert row["box"].pixels == 11 * 11
    assert row["visible"].pixels == 1 and row["visible"].psnr is not None


def test_perceptual_column_sees_the_regions_crop(stlpips):
    ours, seen = rendering(), frame()
    rows = by_region(evaluate_image(ours, seen, REGIONS, stlpips))
    assert rows["full"].lpips == pytest.approx(float(stlpips(ours.rgb, seen.truth.rgb)), rel=1e-5)
    box = (slice(6, 54), slice(9, 39))
    assert rows["box"].lpips == pytest.approx(float(stlpips(ours.rgb[box], seen.truth.rgb[box])), rel=1e-5)
    hidden = (PERSON & STRIP)[..., None]
    box = (slice(6, 54), slice(19, 31))
    expected = stlpips((ours.rgb * hidden)[box], (seen.truth.rgb * hidden)[box])
    assert rows["hidden"].lpips == pytest.approx(float(expected), rel=1e-5)


def test_a_perfect_rendering():
    seen = frame()
    perfect = Rendering(seen.truth.rgb, seen.truth.mask.float(), seen.truth.mask.float(), torch.zeros(0, 2))
    rows = evaluate_image(perfect, seen, REGIONS, None)
    assert all((row.psnr, row.ssim, row.mask_iou) == (100, 1, 1) for row in rows)
    assert all(summarise(rows)[region]["psnr_capped"] == 1 for region in REGIONS)


def test_frames_are_taken_one_at_a_time_without_gradients():
    alive = []

    def frames():
        for index in range(3):
            alive.append(index)
            yield frame(index=index)

    def render(seen):
        assert alive[-1] == seen.index and not torch.is_grad_enabled()
        return rendering()

    rows = evaluate_frames(render, frames(), ("full", "hidden"), None)
    wanted = [(i, region) for i in range(3) for region in ("full", "hidden")]
    assert [(row.frame, row.region) for row in rows] == wanted
    with pytest.raises(ConfigError, match="unknown regions"):
        evaluate_frames(lambda _: rendering(), [frame()], ("whole",), None)


def test_the_perceptual_metric_on_every_third_frame(stlpips):
    frames = [frame(index=index) for index in range(4)]
    rows = evaluate_frames(lambda _: rendering(), frames, ("hidden",), stlpips, perceptual_every=3)
    assert [row.lpips is None for row in rows] == [False, True, True, False]
    assert all(row.psnr is not None for row in rows)


def test_summary_counts_every_image_once_and_leaves_out_what_is_missing():
    rows = [
        ImageRow(0, 1, "full", 10, psnr=20.0, ssim=0.5, lpips=None, mask_iou=1.0),
        ImageRow(1, 1, "full", 10, psnr=100.0, ssim=0.7, lpips=0.25, mask_iou=None),
        ImageRow(2, 1, "full"),
        ImageRow(0, 0, "hidden"),
    ]
    summary = summarise(rows)
    assert summary["full"] == {
        "psnr": 60.0, "ssim": pytest.approx(0.6), "lpips": 0.25, "mask_iou": 1.0,
        "depth_error_mm": None, "images": 2, "lpips_images": 1, "depth_images": 0, "psnr_capped": 1,
        "spill": None, "holes": None,
    }  # fmt: skip
    empty = {
        "psnr": None,
        "ssim": None,
        "lpips": None,
        "mask_iou": None,
        "images": 0,
        "depth_error_mm": None,
        "lpips_images": 0,
        "depth_images": 0,
        "psnr_capped": 0,
        "spill": None,
        "holes": None,
    }
    assert summary["hidden"] == summary["box"] == empty


def test_per_image_csv(tmp_path):
    path = tmp_path / "per_image.csv"
    write_per_image_csv(
        path, evaluate_image(rendering(), frame(with_truth=False), ("visible", "hidden"), None)
    )
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["region"] for line in lines] == ["visible", "hidden"]
    assert lines[0]["camera"] == "3" and lines[0]["frame"] == "7" and float(lines[0]["psnr"]) > 5
    assert lines[1]["psnr"] == lines[1]["mask_iou"] == ""


def test_regions_by_what_training_saw():
    """Each pixel of the true mask belongs to the class of the place that it shows; a rim beyond it to none."""
    shown = np.full((HEIGHT, WIDTH), -1, np.int8)
    shown[PERSON.numpy()] = UNSEEN
    shown[10:30, 12:36] = MANY
    shown[30:40, 12:36] = ONE
    shown[0:5] = ONE  # outside the mask: does not count
    names = ("seen_many", "seen_one", "unseen")
    rows = by_region(evaluate_image(rendering(), frame(), names, None, lambda _: shown))
    parts = {"seen_many": (10, 30), "seen_one": (30, 40), "unseen": (40, 50)}
    for name, lines in parts.items():
        pixels = rectangle(lines, (12, 36))
        assert rows[name].pixels == int(pixels.sum())
        assert rows[name].psnr == pytest.approx(exact(pixels, pixels)[0], abs=1e-4)
        assert rows[name].mask_iou == 1 and rows[name].lpips is None
    # the three together are the person: nothing is counted twice or lost
    assert sum(row.pixels for row in rows.values()) == int(PERSON.sum())


@pytest.mark.parametrize(("name", "number"), [("seen_many", MANY), ("seen_one", ONE), ("unseen", UNSEEN)])
@pytest.mark.parametrize("last", [30, 31])
def test_the_perceptual_metric_looks_at_what_is_hardly_seen_where_it_is_most_of_the_person(
    name, number, last
):
    """The person's rows are 10 to 50: 20 of them are half, 21 are more."""
    shown = np.full((HEIGHT, WIDTH), MANY if number != MANY else ONE, np.int8)
    shown[10:last, 12:36] = number
    shown[0:5] = number  # outside the person: makes no share of it
    seen = []

    class Metric:
        def over_black(self, rgb, truth):
            seen.append((rgb.clone(), truth.clone()))
            return 0.25

    row = evaluate_image(rendering(), frame(), (name,), Metric(), lambda _: shown)[0]
    if last == 30 or name == "seen_many":
        assert row.lpips is None and not seen
        return
    assert row.lpips == 0.25
    counted = PERSON & torch.from_numpy(shown == number)
    assert sum(int((picture.sum(dim=2) > 0).sum()) for _, picture in seen) <= int(counted.sum())
    assert seen[0][1].sum() == pytest.approx(float(frame().truth.rgb[counted].sum()), rel=1e-5)


@pytest.mark.parametrize("classes", [None, lambda _: None])
def test_what_was_seen_is_null_where_it_is_not_known(classes):
    rows = evaluate_image(rendering(), frame(), ("full", "seen_many", "unseen"), None, classes)
    assert [row.pixels > 0 for row in rows] == [True, False, False]
    assert all(summarise(rows)[name]["psnr"] is None for name in ("seen_many", "unseen"))


def test_spill_and_holes_of_a_picture():
    wrong = PERSON & ~rectangle((20, 30), (16, 32)) | rectangle((20, 30), (40, 48))
    drawn = rendering(wrong)
    row = by_region(evaluate_image(drawn, frame(), ("full", "box"), None))["full"]
    truth = frame().truth.rgb.double().numpy()
    error = inside = 0.0
    missing = deep = 0
    for y in range(HEIGHT):
        for x in range(WIDTH):
            square = float(((drawn.rgb[y, x].double().numpy() - truth[y, x]) ** 2).sum())
            error += square
            inside += square * bool(PERSON[y, x])
            if (
                11 <= y < 49 and 13 <= x < 35
            ):  # a pixel off each edge: a hundredth of 40 rows is less than one
                deep += 1
                missing += not wrong[y, x]
    assert row.spill == pytest.approx(1 - inside / error)
    assert row.holes == pytest.approx(missing / deep)
    assert missing == 160 and deep == 38 * 22


def test_spill_and_holes_are_none_where_nothing_tells():
    perfect = Rendering(frame().truth.rgb, PERSON.float(), PERSON.float(), torch.zeros(0, 2))
    row = evaluate_image(perfect, frame(), ("full",), None)[0]
    assert row.spill is None and row.holes == 0
    thin = rectangle((10, 50), (12, 14))
    assert evaluate_image(rendering(thin), frame(person=thin), ("full",), None)[0].holes is None
    assert evaluate_image(rendering(), frame(), ("box",), None)[0].spill is None


def test_a_gain_is_the_least_squares_one_of_each_camera():
    gains = {3: (0.5, 0.8, 1.25), 4: (1.0, 2.0, 0.7)}
    made = noise(HEIGHT, WIDTH)[0].float() * 0.4 * PERSON[..., None]

    def seen(camera: int) -> Frame:
        rgb = made * torch.tensor(gains[camera])
        rgb[0, 0] = 1.0  # outside the person: does not count
        return frame(camera_index=camera, truth=Truth(rgb, PERSON))

    def render(_: Frame) -> Rendering:
        return Rendering(made, PERSON.float(), PERSON.float(), torch.zeros(0, 2))

    views = [seen(3), seen(4), seen(3), frame(camera_index=5, with_truth=False)]
    found = camera_gains(render, views)
    for camera, gain in gains.items():
        assert found[camera] == pytest.approx(gain, abs=1e-5)
    assert found[5] is None
    torch.testing.assert_close(with_gains(render, found)(views[1]).rgb, made * torch.tensor(gains[4]))
    torch.testing.assert_close(with_gains(render, found)(views[3]).rgb, made)


def test_no_gain_lowers_the_error_more_than_the_fitted_one():
    view = frame()
    drawn = rendering()
    gain = camera_gains(lambda _: drawn, [view])[3]
    pixels = PERSON & (drawn.alpha > 0.5)

    def error(factor) -> float:
        return float(((drawn.rgb * torch.tensor(factor) - view.truth.rgb)[pixels] ** 2).sum())

    for channel in range(3):
        for step in (-0.02, 0.02):
            other = list(gain)
            other[channel] += step
            assert error(other) > error(gain)
