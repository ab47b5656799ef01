"""Error against training time of several runs, as one inline SVG a scene."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence

from occfusion.compare.reading import RunRecord
from occfusion.report.tables import heading

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Okabe and Ito's palette: told apart with any colour vision."""
DASHES = ("-", "--", ":", "-.")
SHOWN = ("psnr", "lpips", "mask_iou", "ssim")
"""The panels, in their order; a metric that no run of the scene has is left out."""


def curves_svg(runs: Sequence[RunRecord], names: Sequence[str]) -> str:
    """Returns an `<svg>` element with one panel a metric and one line a run; empty where no run has a curve.

    Training seconds count from the start of the run, earlier stages included. Runs of one method share a
    colour, and their seeds differ in dashes. Different perceptual metrics get panels of their own.

    Args:
        runs: of one scene.
        names: of the runs' methods, in the same order.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    panels = _panels(runs)
    if not panels:
        return ""
    methods, lines = list(dict.fromkeys(names)), {}
    with rc_context({"svg.hashsalt": f"{runs[0].dataset} {runs[0].scene}", "font.size": 9}):
        drawing = Figure(figsize=(3.5 * len(panels), 3.1), layout="constrained")
        FigureCanvasSVG(drawing)
        for number, (metric, perceptual) in enumerate(panels, 1):
            axes = drawing.add_subplot(1, len(panels), number)
            for run, name in zip(runs, names, strict=True):
                if metric == "lpips" and run.metrics["perceptual_metric"] != perceptual:
                    continue
                points = [(p.seconds, value) for p in run.curve if (value := p.values[metric]) is not None]
                label = f"{name}, seed {run.seed}"
                lines[label] = axes.plot(
                    [x for x, _ in points], [y for _, y in points], marker="o", markersize=3, label=label,
                    color=COLOURS[methods.index(name) % len(COLOURS)], linestyle=DASHES[run.seed % len(DASHES)],
                )[0]  # fmt: skip
            axes.set_title(heading(metric, perceptual).removesuffix(" x1000"), fontsize=10)
            axes.set_xlabel("training seconds")
            axes.set_xscale("symlog", linthresh=1.0)  # measured at 0, t, 2t, 4t, ...
            axes.grid(alpha=0.3)
        drawing.legend(handles=list(lines.values()), loc="outside lower center", ncols=4, fontsize=8)
        text = io.StringIO()
        drawing.savefig(
            text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None}
        )
    return _inline(text.getvalue())


def _panels(runs: Sequence[RunRecord]) -> list[tuple[str, str | None]]:
    panels: list[tuple[str, str | None]] = []
    for metric in SHOWN:
        measured = [run for run in runs if any(p.values[metric] is not None for p in run.curve)]
        if metric == "lpips":
            panels += [
                (metric, name) for name in sorted({str(r.metrics["perceptual_metric"]) for r in measured})
            ]
        elif measured:
            panels.append((metric, None))
    return panels


def _inline(document: str) -> str:
    """Returns the `<svg>` element alone, without prolog and metadata, whose addresses an HTML page has no use for."""
    document = document[document.index("<svg") :]
    return re.sub(r"<metadata>.*?</metadata>", "", document, flags=re.DOTALL)
