"""The run folder: the name of everything in it, and the reading of the small records that a run leaves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from occfusion.errors import CheckpointError
from occfusion.files.digest import changed
from occfusion.files.jsonfile import parse_json

STAGES = ("init", "optim", "refine")
"""The stages of an avatar's training, in their order; each has a folder of its own."""
METRICS = ("psnr", "ssim", "lpips", "mask_iou")
"""Figures of `metrics.json` that are measured along the error curve too."""
FIGURES = (*METRICS, "depth_error_mm", "spill", "holes")
"""Figures of each region in `metrics.json`."""
REGIONS = ("full", "box", "visible", "hidden", "seen_many", "seen_one", "unseen")
"""Regions of `metrics.json`: held-out cameras, training views, held-out cameras by what training saw of the body."""


class Inside:
    """A name in a folder: gives the path of it in the folder whose attribute it is."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, folder: Any, _kind: type) -> Path:
        """Returns where it lies; it need not exist."""
        path: Path = folder.path / self._name
        return path


@dataclass(frozen=True)
class FrameFolder:
    """A folder with two pictures for each frame, named by the frame's number, and a manifest.

    Attributes:
        path: the folder, with the first pictures.
        second: name of the folder in it with the second ones.
    """

    path: Path
    second: str

    manifest = Inside("manifest.json")
    """With what each picture was made."""

    def picture(self, frame: int) -> Path:
        """Returns where the picture of a frame lies."""
        return self.path / f"{frame_name(frame)}.png"

    def second_picture(self, frame: int) -> Path:
        """Returns where the second picture of a frame lies."""
        return self.path / self.second / f"{frame_name(frame)}.png"

    def altered(self) -> list[Path]:
        """Returns pictures that are there and not as its manifest has them; the manifest itself where it is damaged."""
        if not self.manifest.is_file():
            return []
        try:
            records = read_json(self.manifest)["frames"].values()
            known = {name: value for record in records for name, value in record.get("sha256", {}).items()}
            return [path for path in changed(self.path, known) if path.is_file()]
        except (AttributeError, CheckpointError, KeyError, TypeError, ValueError):
            return [self.manifest]


def frame_name(frame: int) -> str:
    """Returns the name of a frame in a run folder: its number, with six digits."""
    return f"{frame:06d}"


@dataclass(frozen=True)
class StageFolder:
    """The folder of one stage of a run.

    Attributes:
        path: the folder.
    """

    path: Path

    avatar = Inside("avatar.safetensors")
    """The avatar alone, as the stage left it."""
    checkpoint = Inside("last.ckpt")
    """What a stopped stage continues from."""
    earlier_checkpoint = Inside("previous.ckpt")
    """The one before, for where that one is damaged."""
    bad_step = Inside("bad_step.npz")
    """The frame of a step that was not finite, for `occfusion replay`."""
    record = Inside("stage.json")
    """Written last: the stage is done, with its training seconds and the fingerprint of its avatar."""

    @property
    def damage(self) -> str | None:
        """What is wrong with what the finished stage left; None: nothing, or it is not finished."""
        if not self.record.is_file():
            return None
        try:
            record = read_json(self.record)
            float(record["train_seconds"])
            gone = changed(self.path, {self.avatar.name: record["sha256"]} if "sha256" in record else {})
        except (CheckpointError, KeyError, TypeError, ValueError):
            return f"{self.record} is damaged"
        return f"{gone[0]} is missing, or not as the stage left it" if gone else None

    @property
    def has_avatar(self) -> bool:
        """Whether the stage is done and left an avatar, which is whole."""
        return self.record.is_file() and self.avatar.is_file() and self.damage is None


@dataclass(frozen=True)
class RunFolder:
    """All names in a run folder.

    Attributes:
        path: the folder.
    """

    path: Path

    # --- what the run is -----------------------------------------------------------------------------

    config = Inside("config.yaml")
    """The resolved settings."""
    environment = Inside("environment.json")
    """Whose folder it is, on what machine and with which versions; its creation claims the folder."""
    plan = Inside("plan.json")
    """What the scene needs and what was left out."""
    finished = Inside("finished.json")
    """What the results belong to; the last thing that a run writes."""
    lock = Inside(".at_work")
    """Held by the process at work in the folder."""

    @property
    def shared(self) -> Path:
        """Where results of stages are shared with the runs beside this one."""
        return self.path.parent / ".shared"

    # --- what the stages leave -----------------------------------------------------------------------

    def stage(self, name: str) -> StageFolder:
        """Returns the folder of a stage."""
        return StageFolder(self.path / name)

    occlusion = Inside("occlusion")
    """What a simulated occlusion hides of each training frame."""

    @property
    def masks(self) -> FrameFolder:
        """Complete masks of the initialisation stage; beside each how uncertain it is."""
        return FrameFolder(self.path / "masks", "uncertainty")

    @property
    def inpainted(self) -> FrameFolder:
        """References of the refinement stage; beside each where it counts."""
        return FrameFolder(self.path / "inpainted", "regions")

    completion = Inside("completion.npz")
    """Colours of the body's surface, those of what no frame shows completed; one row a vertex."""
    completion_picture = Inside("completion.png")
    """The same as a picture of front and back."""
    point_cloud = Inside("point_cloud.ply")
    """Canonical Gaussians in the 3DGS layout."""
    losses = Inside("losses.csv")
    """Every term, rate and count a step."""
    curve = Inside("error_vs_time.csv")
    """Error against training time."""
    tensorboard = Inside("tensorboard")
    """TensorBoard's files, a folder a stage."""
    motion = Inside("motion.npz")
    """Poses of the sequence, frame by frame."""
    cameras = Inside("cameras.json")
    """Cameras of the training and held-out views."""

    def wandb_id(self, stage: str) -> Path:
        """Returns where the number lies under which Weights & Biases knows a stage."""
        return self.path / "wandb" / f"{stage}.id"

    # --- what the evaluation leaves ------------------------------------------------------------------

    metrics = Inside("metrics.json")
    """Means over images, region by region."""
    per_image = Inside("per_image.csv")
    """One row a region of an evaluated image."""
    per_camera = Inside("per_camera.csv")
    """Means camera by camera."""
    per_frame = Inside("per_frame.csv")
    """Means frame by frame."""
    pictures = Inside("pictures")
    """Folder of comparisons for people."""
    held_out_picture = Inside("pictures/held_out.png")
    """Held-out views: truth, rendering, error; a description of its parts lies beside it."""
    training_picture = Inside("pictures/training.png")
    """Training views in the same way."""
    before_after = Inside("pictures/before_after.png")
    """Frames of the video above the avatar in the same pose."""
    turntable = Inside("pictures/turntable.webp")
    """A film of one turn around the avatar."""
    directions_picture = Inside("pictures/directions.png")
    """The body, coloured by how many directions training saw each place from."""
    report = Inside("report.md")
    """The page a person looks at first."""

    # --- what the training of a prior leaves instead -------------------------------------------------

    @property
    def checkpoint(self) -> Path:
        """What a stopped training of a prior continues from."""
        return StageFolder(self.path).checkpoint

    corpus = Inside("corpus")
    """Folder of the examples that a prior learns from."""
    prior_weights = Inside("prior.safetensors")
    """The trained network."""
    prior_card = Inside("card.json")
    """How it was trained, and its figures."""

    # --- reading ---------------------------------------------------------------------------------------

    @property
    def taken_over(self) -> list[Path]:
        """What a later call on the same folder would take over instead of doing it."""
        stages = (self.stage(name).path for name in STAGES)
        return [*stages, self.masks.path, self.inpainted.path, self.metrics, self.curve, self.losses]

    @property
    def results(self) -> list[Path]:
        """What a finished run hands to users, and does not do again."""
        avatars = [self.stage(name).avatar for name in STAGES]
        tables = [self.metrics, self.per_image, self.per_camera, self.per_frame]
        return [*avatars, self.point_cloud, *tables, self.motion, self.cameras, self.report]

    @property
    def measured_in_training(self) -> list[Path]:
        """Tables that only training could make again."""
        return [self.curve, self.losses]

    def altered_tables(self) -> list[Path]:
        """Returns those of `measured_in_training` that are not as the end of the run left them."""
        try:
            known = dict(read_json(self.finished)["tables"])
            return [self.path / name for name in changed(self.path, known)]
        except (CheckpointError, KeyError, TypeError, ValueError):
            return []

    def check_is_run(self) -> None:
        """Refuses a folder that no run has claimed.

        Raises:
            CheckpointError: not a run folder.
        """
        if not self.config.is_file():
            raise CheckpointError(
                f"{self.path} is not a run folder: {self.config.name} is missing; name the folder that "
                "training printed, such as runs/synthetic/001-clean/E"
            )

    def read_metrics(self) -> dict[str, Any]:
        """Returns the content of `metrics`.

        Raises:
            CheckpointError: the run has not come to its end, or the file is damaged.
        """
        return read_json(self.metrics)

    def train_seconds(self) -> dict[str, float | None]:
        """Returns the training seconds of each stage, None where it did not run, and their `total`."""
        known = {stage: self.stage(stage).record for stage in STAGES}
        seconds = {
            stage: round(float(read_json(record)["train_seconds"]), 3) if record.is_file() else None
            for stage, record in known.items()
        }
        return seconds | {"total": round(sum(value for value in seconds.values() if value is not None), 3)}


def read_json(path: Path) -> dict[str, Any]:
    """Returns the content of one of a run's JSON files.

    Raises:
        CheckpointError: it is missing or damaged; says what to do.
    """
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        why = f"{path} cannot be read ({error.strerror}); is this the folder of a finished run?"
        raise CheckpointError(why) from error
    except ValueError as error:
        raise CheckpointError(f"{path} is not readable JSON ({error}); run the same command again") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} holds no table; run the same command again")
    return content
