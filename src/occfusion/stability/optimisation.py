"""The study of stiff optimisation: on scenes and on problems with a known optimum, as tables and a page."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import torch

from occfusion.data.synthetic import make_synthetic
from occfusion.files.atomic import write_bytes
from occfusion.files.table import write_table
from occfusion.human import embedded_body
from occfusion.human.rendering import Renderer
from occfusion.report.drawing import BELOW, PANEL_HEIGHT, make_logarithmic, panels, png
from occfusion.report.page import markdown_table
from occfusion.stability.gauss_newton import GaussNewton
from occfusion.stability.scene_condition import (
    BINS,
    JOINT_NAMES,
    WORST,
    Look,
    Moved,
    Spectrum,
    along_and_across,
    begin,
    condition,
    in_double,
    mean_blocks,
    moved_by,
    parameter_of,
    pose_matrix,
    share_of_weakest,
    spectrum,
    train,
)
from occfusion.stability.toys import Walk, handed_over, toys, walks

SCENES = ("001-clean", "001-clean-front")
"""A person who turns all round, and one who hardly does."""
QUANTILES = (0.1, 0.5, 0.9)
SEEN = 1e-3
"""Share of the best known Gaussian's curvature from which on one counts as seen."""
RATIOS = (1.0, 1e2, 1e4, 1e6)


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        size: of pictures, pixels.
        frames: of a scene.
        samples: of Gauss-Newton matrices.
        products: of each Lanczos run.
        trained: steps of Adam on a scene.
        walked: steps on the problems with a known optimum.
    """

    size: int = 96
    frames: int = 24
    samples: int = 48
    products: int = 16
    trained: int = 240
    walked: int = 10_000


QUICK = Effort(size=48, frames=4, samples=8, products=3, trained=8, walked=150)


@dataclass(frozen=True)
class SceneStudy:
    """What was found on a scene where its optimisation begins.

    Attributes:
        scene: name.
        spectra: of the groups of the Gaussians, all frames together.
        one_picture: quantiles over seen Gaussians of what a picture knows across the line of sight, over along it.
        all_pictures: quantiles of the condition of each seen Gaussian's place, all frames together.
        pose_condition: of all angles of one frame.
        joints: what is known of each joint of that frame, best angle and worst, as shares of the best of all.
        moved: by Adam from the start, in bins of what is known.
        weakest: share of the means' squared motion along the least known direction: of Adam, and of one plain
            gradient step.
    """

    scene: str
    spectra: tuple[Spectrum, ...]
    one_picture: tuple[float, ...]
    all_pictures: tuple[float, ...]
    pose_condition: float
    joints: tuple[tuple[str, float, float], ...]
    moved: tuple[Moved, ...]
    weakest: tuple[float, float]


def study_scene(root: Path, scene: str, rates: dict[str, float], effort: Effort) -> SceneStudy:
    """Returns what the pictures of an embedded scene say, and where Adam goes in a short training on it.

    The scene has no errors of poses: what `pose_turns` move is wrong.

    Args:
        root: folder of embedded scenes; written where it is missing.
        scene: its name, of a subject below 100.
        rates: of the optimiser's groups.
        effort: how much is measured.
    """
    body = embedded_body()
    data = make_synthetic(root, scene, body, image_size=effort.size, frames=effort.frames, cameras=2)
    data.setup()
    frames = [data.train_frame(k) for k in range(len(data.train_indices))]
    renderer = Renderer("auto")
    avatar = begin(body, frames, renderer, thickness=0.002, dilation=0.02)
    look = Look(avatar, frames, renderer)
    middle = frames[len(frames) // 2]
    double = in_double(avatar, embedded_body(torch.float64))
    spectra = tuple(
        spectrum(Look(double, frames[:: max(len(frames) // 6, 1)], None), group, effort.products)
        for group in ("means", "scales", "opacity", "sh0")
    )
    along, across = along_and_across(look, middle, effort.samples)
    seen = across >= SEEN * across.max()
    blocks = mean_blocks(look, effort.samples)
    values = torch.linalg.eigvalsh(blocks)
    known = values[:, 2] >= SEEN * values[:, 2].max()
    matrix = pose_matrix(Look(double, [middle], None), middle)
    eigenvalues, diagonal = torch.linalg.eigvalsh(matrix), matrix.diagonal().view(-1, 3)
    joints = [
        (name, float(row.max() / diagonal.max()), float(row.min() / diagonal.max()))
        for name, row in zip(JOINT_NAMES, diagonal, strict=True)
    ]
    moved, weakest = _motion(look, blocks, known, rates, effort)
    return SceneStudy(
        scene,
        spectra,
        _quantiles(across[seen] / along[seen]),
        _quantiles(condition(values[known])),
        float(condition(eigenvalues)),
        tuple(joints),
        moved,
        weakest,
    )


def _motion(
    look: Look, blocks: torch.Tensor, known: torch.Tensor, rates: dict[str, float], effort: Effort
) -> tuple[tuple[Moved, ...], tuple[float, float]]:
    groups = ("pose_turns", "opacity", "scales", "sh0")
    avatar = look.avatar
    parameters = {group: parameter_of(avatar, group) for group in ("means", *groups)}
    diagonals = {}
    for group in groups:
        found = GaussNewton(look.residuals(), [parameters[group]]).samples(effort.samples)[0]
        diagonals[group] = found.double().square().mean(0)
    means = parameters["means"]
    descent = torch.zeros_like(means)
    for residual in look.residuals():
        descent += torch.autograd.grad(residual().square().mean(), means)[0]
    before = {group: parameter.detach().clone() for group, parameter in parameters.items()}
    assert look.renderer is not None  # training is in single precision
    train(avatar, look.frames, look.renderer, rates, effort.trained)
    far = {group: parameter.detach() - before[group] for group, parameter in parameters.items()}
    moved = tuple(moved_by(group, diagonals[group], far[group]) for group in groups)
    by_adam, by_descent = (
        share_of_weakest(blocks[known], motion[known]) for motion in (far["means"], descent)
    )
    return moved, (by_adam, by_descent)


def _quantiles(values: torch.Tensor) -> tuple[float, ...]:
    return tuple(torch.quantile(values.double(), torch.tensor(QUANTILES, dtype=torch.float64)).tolist())


def study(
    output: Path, rates: dict[str, float], environment: dict[str, Any], *, quick: bool, tell: Callable[[str], object]
) -> None:  # fmt: skip
    """Measures all, and writes `optimisation.csv`, `.png`, `.md` and `.html` into a folder.

    Args:
        output: the folder, made when missing; scenes are written into it too.
        rates: of the recipe, by groups of the optimiser.
        environment: of this process.
        quick: one scene and few steps.
        tell: is told how it goes on.
    """
    effort = QUICK if quick else Effort()
    scenes = []
    for name in SCENES[:1] if quick else SCENES:
        scenes.append(study_scene(output / "scenes", name, rates, effort))
        tell(f"{name}: measured")
    found = walks(toys(rates), effort.walked)
    tell("problems with a known optimum: walked")
    stalls = [(r, handed_over(r, fresh=True), handed_over(r, fresh=False)) for r in RATIOS]
    rows = [{name: value for name, value in asdict(one).items() if name != "curve"} for one in found]
    write_table(output / "optimisation.csv", list(rows[0]), rows)
    picture = draw_walks(found)
    write_bytes(output / "optimisation.png", picture)
    head = (
        f"{environment['processor']}, {environment['threads']} threads, torch {environment['packages']['torch']}, "
        f"{environment['date']}, `{environment['command']}`. Embedded (synthetic) scenes at {effort.size} px, "
        f"{effort.frames} frames; {effort.samples} samples, {effort.products} products, {effort.trained} steps on "
        f"scenes, {effort.walked} on the problems with a known optimum. A condition of {WORST:.0e} is that or more."
    )
    sections = [*_scene_sections(scenes), *_walk_sections(found), _stall_section(stalls)]
    text = "\n\n".join(["# Stiff optimisation", head, "![steps and seconds](optimisation.png)", *sections])
    write_bytes(output / "optimisation.md", (text + "\n").encode())
    image = base64.b64encode(picture).decode()
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Stiff optimisation</title>'
        f'<h1>Stiff optimisation</h1><p>{escape(head)}</p><img src="data:image/png;base64,{image}">'
        f"<pre>{escape(chr(10).join(sections))}</pre></html>"
    )
    write_bytes(output / "optimisation.html", page.encode())


def draw_walks(found: Sequence[Walk]) -> bytes:
    """Returns a PNG: above, steps to the optimum against the condition; below, what is left against seconds.

    Where an optimiser does not come near in its steps, its point is hollow and stands at the last of them. Below, the
    worse the condition the fainter the line.
    """
    groups = list(dict.fromkeys(one.group for one in found))
    optimisers = list(dict.fromkeys(one.optimiser for one in found))
    figure, axes = panels(2 * len(groups), len(groups), PANEL_HEIGHT, BELOW)
    for column, group in enumerate(groups):
        above, below = axes[column], axes[len(groups) + column]
        for number, optimiser in enumerate(optimisers):
            own = [one for one in found if (one.group, one.optimiser) == (group, optimiser)]
            color = f"C{number}"
            steps = [one.steps or one.curve[-1][0] for one in own]
            above.plot([one.condition for one in own], steps, "-", color=color, label=optimiser)
            for one, count in zip(own, steps, strict=True):
                above.plot(
                    [one.condition], [count], "o", color=color, mfc=color if one.steps else "white", ms=4
                )
            for k, one in enumerate(own):
                each = one.seconds / max(one.steps or one.curve[-1][0], 1)
                line = [(each * count, max(left, 1e-8)) for count, left in one.curve if count]
                below.plot(*zip(*line, strict=True), color=color, alpha=1.0 - 0.7 * k / max(len(own) - 1, 1))
        for panel in (above, below):
            make_logarithmic(panel)
        above.set_title(f"{group}: steps", fontsize=9)
        above.set_xlabel("condition", fontsize=8)
        below.set_title("share of the distance left", fontsize=9)
        below.set_xlabel("seconds of one problem", fontsize=8)
        if column == 0:
            above.legend(fontsize=6)
    return png(figure)


# --- tables ----------------------------------------------------------------------------------------------------


def _scene_sections(scenes: Sequence[SceneStudy]) -> list[str]:
    spectra = [
        [one.scene, part.group, str(part.parameters), f"{part.largest:.1e}", *(f"{share:.0%}" for share in part.below)]
        for one in scenes
        for part in one.spectra
    ]  # fmt: skip
    places = [
        [one.scene, what, *(f"{value:.1e}" for value in values)]
        for one in scenes
        for what, values in (
            ("one picture: across the line of sight / along it", one.one_picture),
            ("all pictures: best direction / worst", one.all_pictures),
        )
    ]
    joints = [
        [joint[0], *(f"{value:.1e}" for one in scenes for value in one.joints[k][1:])]
        for k, joint in enumerate(scenes[0].joints)
    ]
    conditions = ", ".join(f"{one.scene}: {one.pose_condition:.1e}" for one in scenes)
    moved = [
        [one.scene, part.group, *(_share_and_distance(part, k) for k in range(len(BINS)))]
        for one in scenes
        for part in one.moved
    ]
    weakest = ", ".join(f"{one.scene}: {one.weakest[0]:.2f} and {one.weakest[1]:.4f}" for one in scenes)
    return [
        "## Spectra of the Gaussians' parameters",
        markdown_table(("scene", "group", "numbers", "largest", "< 1e-2", "< 1e-4", "< 1e-6 of it"), spectra),
        "## Places of Gaussians",
        markdown_table(("scene", "ratio of curvatures", "10 %", "median", "90 %"), places),
        "## Angles of joints",
        f"Condition of all 72 angles in one frame: {conditions}. Curvature by joint, best angle and worst, as shares "
        "of the best of all.",
        markdown_table(("joint", *(f"{one.scene}, {which}" for one in scenes for which in ("best", "worst"))), joints),
        "## Where Adam goes",
        "Root mean square motion of numbers by what the data know of them, as a share of the best known: share of the "
        "numbers, motion. The right turn of every joint is 0.",
        markdown_table(("scene", "group", "1 to 0.1", "to 1e-2", "to 1e-3", "to 1e-4", "less"), moved),
        "Share of the means' squared motion along the direction that the data know least, of Adam and of one gradient "
        f"step; a third would be any direction: {weakest}.",
    ]  # fmt: skip


def _share_and_distance(part: Moved, k: int) -> str:
    distance = part.distance[k]
    return "-" if math.isnan(distance) else f"{part.share[k]:.1%}: {distance:.1e}"


def _walk_sections(found: Sequence[Walk]) -> list[str]:
    optimisers = list(dict.fromkeys(one.optimiser for one in found))
    cells = []
    for group, place in dict.fromkeys((one.group, one.place) for one in found):
        own = {one.optimiser: one for one in found if (one.group, one.place) == (group, place)}
        first = next(iter(own.values()))
        shown = [
            f"({own[name].distance:.2g} left)" if own[name].steps is None else str(own[name].steps)
            for name in optimisers
        ]
        cells.append([group, f"{place:g}", f"{first.condition:.1e}", *shown])
    return [
        "## Steps to a known optimum",
        "Until 5 % of the distance at the start is left; in brackets, what is left after all steps.",
        markdown_table(("group", "at", "condition", *optimisers), cells),
    ]


def _stall_section(stalls: Sequence[tuple[float, float, float]]) -> str:
    cells = [[f"{ratio:.0e}", f"{fresh:.3f}", f"{kept:.3f}"] for ratio, fresh, kept in stalls]
    heading = ("loss before / after", "fresh moments, as the stages have them", "moments of the stage before")
    return (
        "## Hand-over between stages\n\nShare of the distance to a new target that is left after 1800 steps.\n\n"
        + markdown_table(heading, cells)
    )
