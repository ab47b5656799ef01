"""The comparison as tables: Markdown, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from occfusion.compare.figures import Summary, quantities, summarise_scenes, summarise_seeds, targets
from occfusion.compare.reading import Fault, RunRecord
from occfusion.files.atomic import write_bytes
from occfusion.files.table import write_table
from occfusion.report.tables import DECIMALS, PERCEPTUAL_SCALE, figure, heading

PAPER_COLUMNS = ("psnr", "ssim", "lpips", "minutes")
PAPER_DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 2, "minutes": 0}
NOTES = (
    "Held-out cameras, full frame; mean ± sample standard deviation. Over seeds: within one scene. Over scenes: of "
    "the scenes' means, every scene counting the same; in brackets the deviation over seeds within a scene. Time is "
    "training alone, all stages; `to A`: training seconds until the PSNR on the curve's images reaches the final "
    "one of variant A on that scene (linear between measurements; a dash where it never does or A was not run). "
    "`paper`: the authors' figures on ZJU-MoCap (LPIPS x1000, minutes on a TITAN RTX); on other data they are there "
    "for the order alone."
)
Grid = tuple[list[str], list[list[str]]]


def perceptual_names(runs: Sequence[RunRecord]) -> list[str]:
    """Returns the names of the perceptual metrics that the runs were measured with."""
    return sorted({str(n) for run in runs if (n := run.metrics["perceptual_metric"]) is not None})


def run_grid(runs: Sequence[RunRecord]) -> Grid:
    """Returns header and one row a run."""
    names, goal = perceptual_names(runs), targets(runs)
    known = [quantities(run, goal.get((run.dataset, run.scene, run.recipe))) for run in runs]
    has_depth = any(values["full.depth_error_mm"] is not None for values in known)
    depth = [heading("depth_error_mm", None)] if has_depth else []
    header = ["scene", "variant", "seed", *_headings(names), *depth]
    header += ["hidden PSNR", "seconds", "to A", "MB", "Gaussians", "run"]
    rows = []
    for run, values in zip(runs, known, strict=True):
        perceptual = [
            figure("lpips", values["full.lpips"] if run.metrics["perceptual_metric"] == name else None)
            for name in names
        ]
        cells = [figure("psnr", values["full.psnr"]), figure("ssim", values["full.ssim"]), *perceptual]
        cells.append(figure("mask_iou", values["full.mask_iou"]))
        cells += [figure("depth_error_mm", values["full.depth_error_mm"])] if has_depth else []
        cells.append(figure("psnr", values["hidden.psnr"]))
        others = [_number(values[key], 1) for key in ("seconds", "seconds_to_target")]
        others += [_number(values[key], 0) for key in ("memory_mb", "gaussians")]
        rows.append(
            [f"{run.dataset} {run.scene}", run.variant, str(run.seed), *cells, *others, str(run.folder)]
        )
    return header, rows


def summary_grid(summaries: Sequence[Summary], names: Sequence[str]) -> Grid:
    """Returns header and one row a summary, the paper's figures in columns of their own at the end.

    Args:
        summaries: of one level.
        names: of the perceptual metrics, one column each.
    """
    has_depth = any("full.depth_error_mm" in s.values for s in summaries)
    depth = [heading("depth_error_mm", None)] if has_depth else []
    header = ["data", "variant", "seeds", "scenes", *_headings(names), *depth, "seconds", "to A", "MB"]
    header += ["paper PSNR", "paper SSIM", "paper LPIPS x1000", "paper minutes"]
    rows = []
    for s in summaries:
        cells = [_cell(s, "full.psnr", DECIMALS["psnr"]), _cell(s, "full.ssim", DECIMALS["ssim"])]
        for name in names:
            known = s.perceptual_metric == name
            cells.append(_cell(s, "full.lpips", DECIMALS["lpips"], PERCEPTUAL_SCALE) if known else "-")
        cells.append(_cell(s, "full.mask_iou", DECIMALS["mask_iou"]))
        cells += [_cell(s, "full.depth_error_mm", DECIMALS["depth_error_mm"])] if has_depth else []
        cells += [_cell(s, "seconds", 1), _cell(s, "seconds_to_target", 1), _cell(s, "memory_mb", 0)]
        paper = [_number(s.paper.get(key), PAPER_DECIMALS[key]) for key in PAPER_COLUMNS]
        rows.append([f"{s.dataset} {s.scene}".strip(), s.method, str(s.seeds), str(s.scenes), *cells, *paper])
    return header, rows


def all_grids(runs: Sequence[RunRecord]) -> list[tuple[str, Grid]]:
    """Returns titled tables: over scenes, over all images, over the seeds of each scene."""
    names, wide = perceptual_names(runs), summarise_scenes(runs)
    return [
        ("Over scenes", summary_grid([s for s in wide if s.level == "scenes"], names)),
        ("Over all images", summary_grid([s for s in wide if s.level == "images"], names)),
        ("Over seeds, scene by scene", summary_grid(summarise_seeds(runs), names)),
    ]


def write_summary_csv(path: Path, runs: Sequence[RunRecord]) -> None:
    """Writes every quantity of every summary in its own unit (perceptual figures unscaled, seconds, MB)."""
    rows: list[dict[str, Any]] = []
    for s in [*summarise_scenes(runs), *summarise_seeds(runs)]:
        row: dict[str, Any] = {
            "level": s.level, "dataset": s.dataset, "scene": s.scene, "method": s.method, "seeds": s.seeds,
            "scenes": s.scenes, "perceptual_metric": s.perceptual_metric,
        }  # fmt: skip
        for name, value in s.values.items():
            row |= {f"{name}.{key}": known for key, known in vars(value).items()}
            row[f"{name}.seed_deviation"] = s.seed_deviation.get(name)
        row |= {f"paper.{key}": s.paper.get(key) for key in PAPER_COLUMNS}
        rows.append(row)
    write_table(path, list(dict.fromkeys(key for row in rows for key in row)) or ["level"], rows)


def latex_table(grid: Grid, caption: str) -> str:
    """Returns a LaTeX `table` that needs no package; the paper's columns stand behind a double rule."""
    header, rows = grid
    ours = sum(not title.startswith("paper ") for title in header)
    columns = "ll" + "r" * (ours - 2) + ("||" + "r" * (len(header) - ours) if len(header) > ours else "")
    titles, *lines = (" & ".join(_tex(cell) for cell in line) + r" \\" for line in (header, *rows))
    return "\n".join([
        r"\begin{table}", r"\centering", rf"\caption{{{_tex(caption)}}}", rf"\begin{{tabular}}{{{columns}}}", r"\hline",
        titles, r"\hline", *lines, r"\hline", r"\end{tabular}", r"\end{table}", "",
    ])  # fmt: skip


def write_latex(path: Path, runs: Sequence[RunRecord], faults: Sequence[Fault]) -> None:
    """Writes all summary tables as LaTeX; what failed stands in comments."""
    parts = [latex_table(grid, f"{title}. {NOTES}") for title, grid in all_grids(runs)]
    parts += ["% failed: " + f"{fault.what}: {fault.reason}".replace("\n", " ") for fault in faults]
    write_bytes(path, ("\n".join(parts) + "\n").encode())


def _headings(names: Sequence[str]) -> list[str]:
    perceptual = [heading("lpips", name) for name in names]
    return [heading("psnr", None), heading("ssim", None), *perceptual, heading("mask_iou", None)]


def _cell(summary: Summary, name: str, decimals: int, scale: float = 1.0) -> str:
    value = summary.values.get(name)
    if value is None:
        return "-"
    text = f"{value.mean * scale:.{decimals}f}"
    if value.deviation is not None:
        text += f" ± {value.deviation * scale:.{decimals}f}"
    within = summary.seed_deviation.get(name)
    return text if within is None else f"{text} [{within * scale:.{decimals}f}]"


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _tex(text: str) -> str:
    special: dict[str, str | int | None] = {
        "\\": r"\textbackslash{}", "±": r"$\pm$", "`": "'", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
        **{sign: "\\" + sign for sign in "&%$#_{}"},
    }  # fmt: skip
    return text.translate(str.maketrans(special))
