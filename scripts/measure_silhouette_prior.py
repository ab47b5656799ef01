"""Measures the silhouette prior on held-out subjects and motions: IoU inside the hidden region, baselines beside it.

    python scripts/measure_silhouette_prior.py [--weights FILE] [--samples 256] [--output FILE.md]

Every row sees the same people, poses, cameras and occluders. Nothing here may be used to choose anything.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from occfusion.prior_training.random_occluders import centre_strip, random_half
from occfusion.prior_training.silhouette_batches import hidden_batch
from occfusion.prior_training.silhouette_examples import Estimate, draw_camera, draw_poses, make_example
from occfusion.prior_training.silhouette_task import hidden_iou
from occfusion.prior_training.task import Batch
from occfusion.priors.embedded.conditions import GROUPS
from occfusion.priors.embedded.diffusion import sample
from occfusion.priors.embedded.silhouette_net import SilhouetteNet, load_silhouette_net
from occfusion.synth.dress import dress
from occfusion.synth.spec import HELD_OUT_FROM
from occfusion.synth.subject import make_subject

TRUNK = (0, 3, 6, 9, 13, 14)
UPPER_LIMBS = (12, 1, 2, 16, 17)
BODIES = {
    "true pose and shape": Estimate(),
    "true pose, mean shape": Estimate(shape_noise=np.inf),
    "0.08 rad pose noise": Estimate(pose_noise=0.08),
    "0.08 rad, root true": Estimate(pose_noise=0.08, exact=(0,)),
    "0.08 rad, root and trunk true": Estimate(pose_noise=0.08, exact=TRUNK),
    "0.08 rad, also neck, thighs, upper arms true": Estimate(pose_noise=0.08, exact=TRUNK + UPPER_LIMBS),
}


def main() -> None:
    """Prints the table and writes it where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", default=None)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--first-subject", type=int, default=HELD_OUT_FROM)
    parser.add_argument("--subjects", type=int, default=16)
    parser.add_argument(
        "--without-sampling", action="store_true", help="leave out the rows of 20 steps, which are slow"
    )
    parser.add_argument("--output", type=Path, default=None)
    arguments = parser.parse_args()
    held_out = arguments.first_subject >= HELD_OUT_FROM
    numbers = range(arguments.first_subject, arguments.first_subject + arguments.subjects)
    net, card = load_silhouette_net(arguments.weights)
    batches = {
        name: make_batches(numbers, arguments.samples, estimate, held_out)
        for name, estimate in BODIES.items()
    }
    lines = [
        f"{arguments.samples} silhouettes of subjects {numbers[0]} to {numbers[-1]}"
        f"{' (held out, held-out motions)' if held_out else ''}, {card['size']} px, weights {card['sha256'][:12]}",
        "",
        "| | centre half hidden | half plane hidden |",
        "|---|---|---|",
    ]
    for name, row in measure(net, batches, not arguments.without_sampling).items():
        lines.append(f"| {name} | {row['centre']:.3f} | {row['half']:.3f} |")
        print(lines[-1], flush=True)
    if arguments.output is not None:
        arguments.output.write_text("\n".join(lines) + "\n")


def make_batches(numbers: range, count: int, estimate: Estimate, held_out: bool) -> dict[str, list[Batch]]:
    """Returns the same people behind a centre strip and behind a half plane."""
    found: dict[str, list[Batch]] = {"centre": [], "half": []}
    each = -(-count // len(numbers))
    for number in numbers:
        subject = make_subject(number)
        figure = dress(subject)
        rng = np.random.default_rng([9, number])
        examples = []
        for k, pose in enumerate(draw_poses(each, subject.betas, rng, held_out)):
            own = np.random.default_rng([9, number, k])
            camera = draw_camera(np.array([0.0, 0.0, -0.05]), own)
            example = make_example(
                subject, figure, pose, estimate, np.random.default_rng([9, number, k, 1]), camera
            )
            examples.append({name: np.asarray(value) for name, value in vars(example).items()})
        people = [example["person"] > 127 for example in examples]
        angles = np.random.default_rng([9, number, 2])
        found["centre"].append(hidden_batch(examples, [centre_strip(person, 0.5) for person in people]))
        found["half"].append(hidden_batch(examples, [random_half(person, angles) for person in people]))
    return found


def measure(
    net: SilhouetteNet, batches: dict[str, dict[str, list[Batch]]], sampling: bool
) -> dict[str, dict[str, float]]:
    """Returns the mean hidden IoU of each way to complete."""
    methods: dict[str, tuple[str, Callable[[Batch], Tensor]]] = {
        "no completion": ("true pose and shape", lambda b: torch.zeros_like(b.clean) > 1),
        "skeleton drawn as capsules": ("true pose and shape", capsules),
        "body mesh, true pose, mean shape": ("true pose, mean shape", mesh),
        "body mesh, true pose and shape": ("true pose and shape", mesh),
        "body mesh, 0.08 rad pose noise": ("0.08 rad pose noise", mesh),
        "**prior, true pose and shape**": ("true pose and shape", mean_of(net)),
        "**prior, 0.08 rad pose noise**": ("0.08 rad pose noise", mean_of(net)),
        **{f"prior, {name}": (name, mean_of(net)) for name in BODIES if name.startswith("0.08 rad, ")},
        "prior, true pose, mean shape": ("true pose, mean shape", mean_of(net)),
        "prior, true pose and shape, background not given": (
            "true pose and shape",
            mean_of(net, "background"),
        ),
        "prior, pose without body mesh": ("true pose and shape", mean_of(net, "body")),
        "prior, body mesh without pose": ("true pose and shape", mean_of(net, "limbs")),
        "prior, neither": ("true pose and shape", mean_of(net, "body", "limbs")),
    }
    if sampling:
        methods["prior, one sample of 20 steps"] = ("true pose and shape", sampled(net, 1))
        methods["prior, mean of 4 samples"] = ("true pose and shape", sampled(net, 4))
    table = {}
    for name, (body, complete) in methods.items():
        started = time.monotonic()
        row = {}
        for kind, parts in batches[body].items():
            scores = [hidden_iou(complete(b), b.clean > 0, _hidden(b)) for b in parts]
            row[kind] = float(torch.cat(scores).mean())
        row["seconds"] = time.monotonic() - started
        table[name] = row
    return table


def _hidden(batch: Batch) -> Tensor:
    return (batch.conditions.visible + batch.conditions.background) == 0


def mesh(batch: Batch) -> Tensor:
    """Returns the body mesh's silhouette."""
    return batch.conditions.body[:, :1] > 0.5


def capsules(batch: Batch) -> Tensor:
    """Returns the skeleton with limbs of one thickness, twice that for the trunk."""
    maps = torch.nn.functional.interpolate(batch.conditions.limbs, scale_factor=4.0, mode="bilinear")
    # the maps fall off as exp(-d^2 / 2 w^2) with w of the capsules' radius
    drawn = maps[:, 1 : len(GROUPS)].amax(dim=1, keepdim=True) > float(np.exp(-0.5 * (0.7) ** 2))
    return drawn | (maps[:, :1] > float(np.exp(-0.5 * 2.0**2)))


def mean_of(net: SilhouetteNet, *dropped: str) -> Callable[[Batch], Tensor]:
    """Returns completion by one evaluation of the posterior mean, some conditions not given."""

    def complete(batch: Batch) -> Tensor:
        conditions = batch.conditions.without(*dropped)
        noise = torch.randn(1, *batch.clean.shape[1:], generator=torch.Generator().manual_seed(0))
        return net.probability(conditions, noise) > 0.5

    return complete


def sampled(net: SilhouetteNet, count: int) -> Callable[[Batch], Tensor]:
    """Returns completion by the mean of samples of 20 steps."""

    def complete(batch: Batch) -> Tensor:
        total = torch.zeros_like(batch.clean)
        for k in range(count):
            noise = torch.randn(batch.clean.shape, generator=torch.Generator().manual_seed(k))
            total += sample(lambda x, t: net(x, t, batch.conditions), noise, 20)
        return total > 0.0

    return complete


if __name__ == "__main__":
    main()
