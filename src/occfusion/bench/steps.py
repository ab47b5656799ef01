"""Profiles of training steps: what was measured of each part, as a table, a CSV file and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from occfusion.files.atomic import write_bytes
from occfusion.files.table import write_table
from occfusion.report.drawing import new_figure, png
from occfusion.report.page import markdown_table

PERCEPTUAL = "perceptual term"
RASTERISER = "rasteriser"
DRAWN = 0.02
"""Share of a step from which on a part has a bar of its own in the picture."""


@dataclass(frozen=True)
class PartTime:
    """A part of a step, or all of it; milliseconds a step.

    Attributes:
        name: of the part.
        forward_cpu: processor time of its forward pass, or of all of it where it has no other.
        backward_cpu: of its backward pass.
        wall: time on the wall of both.
    """

    name: str
    forward_cpu: float
    backward_cpu: float
    wall: float

    @property
    def cpu(self) -> float:
        """Processor time of both passes."""
        return self.forward_cpu + self.backward_cpu


@dataclass(frozen=True)
class StepProfile:
    """What the steps of a stage consist of.

    Attributes:
        stage: name of the stage.
        gaussians: at the end.
        size: longer side of the pictures, pixels.
        threads: of torch and the kernels.
        steps: that were measured, with probes and as many without.
        parts: with the most expensive first.
        measured: a step without any probe active, steps with and without in turn.
    """

    stage: str
    gaussians: int
    size: int
    threads: int
    steps: int
    parts: tuple[PartTime, ...]
    measured: PartTime

    @property
    def total(self) -> PartTime:
        """All parts together."""
        return PartTime(
            "sum",
            sum(part.forward_cpu for part in self.parts),
            sum(part.backward_cpu for part in self.parts),
            sum(part.wall for part in self.parts),
        )

    @property
    def agreement(self) -> float:
        """Processor time of the parts together over that of a step without probes."""
        return self.total.cpu / self.measured.cpu

    def share(self, *names: str) -> float:
        """Returns the processor time of some parts, milliseconds."""
        return sum(part.cpu for part in self.parts if part.name in names)

    @property
    def everything_else(self) -> float:
        """Processor time of all but the perceptual term and the rasteriser, milliseconds."""
        return self.total.cpu - self.share(PERCEPTUAL, RASTERISER)


def write_steps(path: Path, profiles: Sequence[StepProfile]) -> None:
    """Writes a CSV file: a row for each part of each profile, for their sum and for the step as it was measured."""
    rows = [
        {
            "stage": profile.stage, "size": profile.size, "threads": profile.threads, "gaussians": profile.gaussians,
            "steps": profile.steps, "part": part.name, "forward_cpu_ms": round(part.forward_cpu, 4),
            "backward_cpu_ms": round(part.backward_cpu, 4), "wall_ms": round(part.wall, 4),
        }
        for profile in profiles
        for part in (*profile.parts, profile.total, profile.measured)
    ]  # fmt: skip
    write_table(path, list(rows[0]), rows)


def steps_text(profiles: Sequence[StepProfile]) -> str:
    """Returns one Markdown table for each profile, with the sum and the step without probes."""
    sections = ["## A step of a run, part by part"]
    for profile in profiles:
        body = [
            [part.name, *(f"{x:.2f}" for x in (part.forward_cpu, part.backward_cpu, part.cpu, part.wall))]
            for part in (*profile.parts, profile.total)
        ]
        measured = profile.measured
        body.append(["measured without probes", "", "", f"{measured.cpu:.2f}", f"{measured.wall:.2f}"])
        threads = "1 thread" if profile.threads == 1 else f"{profile.threads} threads"
        sections += [
            f"### {profile.stage}, {profile.size} px, {profile.gaussians} Gaussians, {threads}",
            f"{profile.steps} steps with probes and {profile.steps} without, in turn. Sum over measured: "
            f"{profile.agreement:.3f}. Everything but {PERCEPTUAL} and {RASTERISER}: {profile.everything_else:.2f} ms.",
            markdown_table(["part", "forward, CPU ms", "backward", "both", "wall ms"], body),
        ]
    return "\n\n".join(sections) + "\n"


def draw_steps(path: Path, profiles: Sequence[StepProfile]) -> None:
    """Draws each profile as a bar of its parts' processor time, the measured step as a line across its end."""
    from matplotlib import colormaps

    figure = new_figure(11, 1.6 + 0.55 * len(profiles))
    axes = figure.add_subplot()
    names = [
        name
        for name in dict.fromkeys(part.name for profile in profiles for part in profile.parts)
        if max(profile.share(name) / profile.total.cpu for profile in profiles) >= DRAWN
    ]
    places = range(len(profiles))
    ends = [0.0] * len(profiles)
    for number, name in enumerate(names):
        lengths = [profile.share(name) for profile in profiles]
        axes.barh(places, lengths, left=ends, color=colormaps["tab20"](number % 20), label=name)
        ends = [end + length for end, length in zip(ends, lengths, strict=True)]
    rest = [profile.total.cpu - end for profile, end in zip(profiles, ends, strict=True)]
    axes.barh(places, rest, left=ends, color="0.8", label=f"parts under {DRAWN:.0%} of a step")
    for place, profile in zip(places, profiles, strict=True):
        label = "measured without probes" if place == 0 else None
        axes.plot([profile.measured.cpu] * 2, [place - 0.42, place + 0.42], "k", linewidth=2, label=label)
    axes.set_yticks(list(places), [f"{p.stage}, {p.size} px, {p.threads} thr." for p in profiles])
    axes.invert_yaxis()
    axes.set_xlabel("CPU ms a step, forward and backward")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    write_bytes(path, png(figure))
