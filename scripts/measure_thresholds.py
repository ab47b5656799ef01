"""How far each threshold of the plan lies from what scenes show: a row a scene in a CSV, and the page made from it.

python scripts/measure_thresholds.py WORK --clip CLIPS/walker    # measures what docs/reference/thresholds.csv lacks
python scripts/measure_thresholds.py WORK --page                 # nothing more than the page from it

Nothing is trained: a scene is observed as a run would, with poses as given and with poses aligned. Scenes are of
subjects below 100, 128 px, 60 frames, a strip in front of four fifths of them. Rows that stand are kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from occfusion.data import registration
from occfusion.files.table import read_table, write_table
from occfusion.observation import evidence, exposure, pose_alignment
from occfusion.observation.frames import misfit_of
from occfusion.plan import decisions, hidden
from occfusion.run.prepare import observe, observe_training_frames
from occfusion.settings.schema import Settings, load_settings
from occfusion.synth import LEVELS

ROOT = Path(__file__).parents[1]
CSV = ROOT / "docs/reference/thresholds.csv"
PAGE = ROOT / "docs/reference/thresholds.md"
SUBJECTS = (3, 1)
SHARED = ["evaluation.perceptual=false", "trainer.accelerator=cpu"]
EMBEDDED = ["dataset.image_size=128", "dataset.frames=60", "dataset.cameras=6"]
CLIP = "walker"


@dataclass(frozen=True)
class Threshold:
    """A number that decides.

    Attributes:
        column: of the statistic it is held against.
        name: of the constant.
        value: of it.
        decides: in words.
        text: how a statistic is written.
    """

    column: str
    name: str
    value: float
    decides: str
    text: Callable[[float], str] = "{:.3g}".format


def percent(value: float) -> str:
    """Returns a share in words."""
    return f"{100 * value:.3g} %"


THRESHOLDS = (
    Threshold("hidden_whole", "evidence.HIDDEN_SHARE", evidence.HIDDEN_SHARE,
              "a frame that misses more of the body's core is occluded: largest of those without the strip", percent),
    Threshold("hidden_strip", "evidence.HIDDEN_SHARE", evidence.HIDDEN_SHARE,
              "the same: median of frames behind the strip", percent),
    Threshold("misfit_given", "evidence.FITTING", evidence.FITTING,
              "less of the body outside the mask, and poses fit: as given", percent),
    Threshold("misfit_aligned", "evidence.FITTING", evidence.FITTING,
              "the same with poses aligned, which is what the plan goes by", percent),
    Threshold("whole", "evidence.FRAMES_TO_JUDGE", evidence.FRAMES_TO_JUDGE,
              "fewer frames of a whole person, and nothing is said of how poses fit", "{:.0f}".format),
    Threshold("most_hidden", "hidden.MOSTLY_HIDDEN", hidden.MOSTLY_HIDDEN,
              "distillation is on where occluded frames hide more, in the median", percent),
    Threshold("lamps_differ", "decisions.AGREED", decisions.AGREED,
              "a lamp on which two halves of the body differ by more is left out", percent),
    Threshold("lit_condition", "decisions.DETERMINED", decisions.DETERMINED,
              "a lamp of a larger condition is left out", "{:.1f}".format),
    Threshold("exposure", "exposure.WORTH", exposure.WORTH,
              "exposures that explain less of how points differ are left as they are", percent),
    Threshold("unseen", "hidden.MUCH_UNSEEN", hidden.MUCH_UNSEEN,
              "from more of the body unseen on, a network completes colours", percent),
    Threshold("turn", "decisions.TURNED", decisions.TURNED,
              "degrees of turning from which on the surface is not closed", "{:.0f}".format),
    Threshold("shift_given", "registration.CERTAIN", registration.CERTAIN,
              "errors from which on cameras are corrected: by bodies as given", "{:.1f}".format),
    Threshold("shift_aligned", "pose_alignment.CERTAIN", pose_alignment.CERTAIN,
              "the same with poses unknown; both have to be certain", "{:.1f}".format),
    Threshold("gain", "pose_alignment.WORTH", pose_alignment.WORTH,
              "an alignment that takes away less of the misfit with masks it was not found by is not taken", percent),
    Threshold("spread_turns", "pose_alignment.FULL_TURN", pose_alignment.FULL_TURN,
              "radians that joints are off, from which on training mends them at full rate; less, less",
              "{:.4f}".format),
    Threshold("spread_place", "pose_alignment.FULL_PLACE", pose_alignment.FULL_PLACE,
              "metres that the place is off: the same", "{:.4f}".format),
)  # fmt: skip


def statistics(make: Callable[[Sequence[str]], Settings]) -> dict[str, float | None]:
    """Returns what thresholds are held against, of one scene."""
    aligned = observe(make([]))
    frames, alignment, registered = aligned.frames, aligned.alignment, aligned.registered
    assert frames is not None
    found: dict[str, float | None] = dict.fromkeys(threshold.column for threshold in THRESHOLDS)
    given = observe_training_frames(aligned.data, aligned.body)
    behind = [f.evidence.hidden_share for f in frames if f.index < 0.8 * len(frames)]
    before = [f.evidence.hidden_share for f in frames if f.index >= 0.8 * len(frames)]
    found["hidden_strip"], found["hidden_whole"] = float(np.median(behind)), float(max(before))
    found["most_hidden"] = float(np.median([f.evidence.hidden_share for f in frames if f.evidence.occluded]))
    for name, observed_frames in (("misfit_given", given), ("misfit_aligned", frames)):
        measured = misfit_of(observed_frames)
        found[name] = None if measured is None else measured[0]
    found["whole"] = float(sum(not f.evidence.occluded for f in frames))
    light = aligned.light
    if light is not None and light.key_light is not None:
        found["lamps_differ"], found["lit_condition"] = light.disagreement, light.key_light.condition
    if light is not None and light.exposure is not None:
        found["exposure"] = light.exposure.explained
    if aligned.coverage is not None:
        found["unseen"] = aligned.coverage.shares()["unseen"]
    if aligned.surface is not None:
        found["turn"] = aligned.surface.turn
    if registered is not None and (r := registered.measured) is not None:
        errors = (*r.shift_error, r.scale_error)
        found["shift_given"] = max(abs(v) / e for v, e in zip((*r.shift, r.scale), errors, strict=True))
    if alignment is not None:
        spreads = [value for name, value in alignment.spreads.items() if name != "place"]
        found["gain"] = alignment.gain
        found["spread_turns"], found["spread_place"] = float(np.median(spreads)), alignment.spreads["place"]
        if registered is not None and not registered.corrections:  # behind a correction nothing is asked
            found["shift_aligned"] = float((np.abs(alignment.picture) / alignment.picture_error).max())
    return found


def settings_of(scene: str, work: Path, clip: Path | None) -> Callable[[Sequence[str]], Settings]:
    """Returns what makes settings of a scene from further overrides."""
    own = [f"dataset.scene={scene}", f"dataset.root={work}", *EMBEDDED]
    if scene == CLIP:
        own = [
            "dataset=zju", f"dataset.root={clip}", "dataset.scene=CoreView_950", f"body.path={clip}/body.npz",
            "evaluation.held_out=false", "dataset.train_frames=[0,100,1]", "dataset.image_size=256",
        ]  # fmt: skip

    def make(more: Sequence[str]) -> Settings:
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            return load_settings(compose("config", [*own, *SHARED, *more]))

    return make


def measure(work: Path, clip: Path | None) -> None:
    """Adds the rows that the table lacks."""
    rows = read_table(CSV) if CSV.is_file() else []
    scenes = [f"{subject:03d}-{level}" for subject in SUBJECTS for level in LEVELS]
    if clip is not None:
        scenes.insert(0, CLIP)
    for scene in scenes:
        if any(row["scene"] == scene for row in rows):
            continue
        found = statistics(settings_of(scene, work, clip))
        rows.append({"scene": scene, **{k: "" if v is None else f"{v:.6g}" for k, v in found.items()}})
        write_table(CSV, ["scene", *found], rows)
        print(scene, found, flush=True)


def page() -> str:
    """Returns the page."""
    rows = read_table(CSV)
    groups = {level: [r for r in rows if r["scene"].endswith(f"-{level}")] for level in LEVELS}
    groups["real clip"] = [r for r in rows if r["scene"] == CLIP]
    counts = ", ".join(f"{name} {len(own)}" for name, own in groups.items())
    lines = [
        "# Thresholds of the plan",
        "",
        "Each number that decides, with what it is held against on scenes: least to most. The nearer a statistic",
        f"comes to its threshold, the less the margin. Scenes: {counts};",
        "synthetic people below number 100 at 128 px, 60 frames, behind a strip in 48; a real clip at 256 px.",
        "Rows are in [thresholds.csv](thresholds.csv).",
        'Made by `python scripts/measure_thresholds.py`, which trains nothing. "-": not measured there.',
        "",
        f"| threshold | value | decides | {' | '.join(groups)} |",
        f"|---|---|---|{'---|' * len(groups)}",
    ]
    for t in THRESHOLDS:
        cells = [_range([r[t.column] for r in own if r[t.column]], t) for own in groups.values()]
        lines.append(f"| `{t.name}` | {t.text(t.value)} | {t.decides} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _range(values: Sequence[str], threshold: Threshold) -> str:
    if not values:
        return "-"
    least, most = (threshold.text(pick(float(v) for v in values)) for pick in (min, max))
    return least if least == most else f"{least} to {most}"


def main() -> None:
    """Measures, or writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder of the written scenes")
    parser.add_argument("--clip", type=Path, help="folder of the real clip: CoreView_950 and body.npz")
    parser.add_argument("--page", action="store_true", help="write the page alone")
    given = parser.parse_args()
    if not given.page:
        measure(given.work.resolve(), given.clip and given.clip.resolve())
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
