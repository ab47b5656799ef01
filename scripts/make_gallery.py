"""Trains embedded people and draws the gallery: each as input, avatar, other motions.

    python scripts/make_gallery.py [--work runs/gallery] [--only 103-clean]

Held-out people, trained one after another. What is trained already is not trained again, so a stopped call goes on.
Writes `docs/gallery.md` and its pictures; with `--only` the pictures of that person alone.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from occfusion.evaluation.pictures import captioned, to_uint8
from occfusion.files.atomic import write_bytes
from occfusion.files.run_folder import RunFolder
from occfusion.human.rendering import Renderer
from occfusion.run.bodies import make_body, make_data
from occfusion.run.loaded import load_run
from occfusion.run.showing import MotionChoice, make_showing
from occfusion.show.film import parse_background, picture_of
from occfusion.show.paths import Framing, orbit
from occfusion.types import Frame

ROOT = Path(__file__).parents[1]
PAGE, PICTURES = ROOT / "docs" / "gallery.md", ROOT / "docs" / "pictures" / "gallery"
SETTINGS = ("speed=fast", "dataset.image_size=256", "evaluation.perceptual=false", "evaluation.curve=false")
SIZE, FILM_SIZE = 320, 288
"""Pixels of a panel of a strip, and of a film."""
STRIP_QUALITY, FILM_QUALITY = 88, 72
FILM_FRAMES = 36
MARGIN = 1.2
"""Side of the square around the person beside the longer side of its box."""
BEHIND, OBLIQUE = 0.5, 0.09
"""Shares of a turn around the person."""
RISE = 0.1
"""Of the camera above the person's middle, radians."""
HEAD = """# Gallery

*Written by `scripts/make_gallery.py`.*

Four embedded people who were held out from all training and tuning. They are synthetic. Each was trained with
`speed=fast` at 256 px from one camera, seed 0. From the left: a frame of that video, the avatar in the same pose from
the same camera, the avatar from behind, and two motions of somebody else. Below, a motion plays while the camera goes
round. Where a person is hidden in many frames, edges of clothes fray and patterns blur; `hard` people, whose clothes
wrinkle and whose poses are off, show it most.

```
python scripts/make_gallery.py
```

One thread of 2 cores of an AMD EPYC, shared with others; no GPU.
"""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Person:
    """What is shown of one embedded person.

    Attributes:
        scene: its name.
        frame: share of the video's training frames from which its input is taken.
        motions: embedded clips, each with the share of it that is shown in the strip.
        film: the clip that plays in its film.
        text: what is hidden, for the page.
    """

    scene: str
    frame: float
    motions: tuple[tuple[str, float], ...]
    film: str
    text: str


PEOPLE = (
    Person("103-clean", 0.4, (("walk", 0.3), ("squat", 0.45)), "walk", "A bar hides half of the person"),
    Person("104-hard-boxes", 0.4, (("reach", 0.5), ("lunge", 0.45)), "lunge", "Boxes stand before the person"),
    Person("106-clean", 0.4, (("wave", 0.5), ("sit", 0.6)), "wave", "A bar hides half of the person"),
    Person("108-hard-poles", 0.4, (("cmu_01_01", 0.5), ("walk", 0.55)), "cmu_01_01", "Poles stand before the person"),
)  # fmt: skip


def main() -> None:
    """Trains what is missing and draws."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "gallery", help="folder for the runs")
    parser.add_argument("--only", choices=[person.scene for person in PEOPLE], help="this person alone")
    arguments = parser.parse_args()
    for person in PEOPLE:
        if arguments.only in (None, person.scene):
            train(person, arguments.work)
            draw(person, arguments.work)
    if arguments.only is None:
        write_bytes(PAGE, page(arguments.work).encode())


def train(person: Person, work: Path) -> None:
    """Trains a person, or goes on with it; a finished run is told from its folder."""
    command = [sys.executable, str(ROOT / "train.py"), f"dataset.scene={person.scene}", *SETTINGS]
    command += [f"output_dir={work / person.scene}", f"dataset.root={work / 'data'}"]
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    subprocess.run([*command, f"shared_dir={work / 'shared'}"], check=True, cwd=ROOT, env=environment)


def draw(person: Person, work: Path) -> None:
    """Writes a person's strip and film."""
    folder = work / person.scene
    loaded, renderer = load_run(folder), Renderer("auto")
    data = make_data(loaded.settings, make_body(loaded.settings.body))
    data.setup()
    frame = data.train_frame(int(person.frame * len(data.train_indices)))
    ours = renderer.frame(loaded.avatar, frame).rgb
    panels = [
        captioned(cut(to_uint8(frame.rgb), frame), f"input, frame {frame.index}"),
        captioned(cut(to_uint8(ours), frame), "avatar"),
        captioned(around(folder, None, [(0.0, BEHIND)])[0], "from behind"),
        *(
            captioned(around(folder, motion, [(moment, OBLIQUE)])[0], f"motion: {motion}")
            for motion, moment in person.motions
        ),
    ]
    PICTURES.mkdir(parents=True, exist_ok=True)
    strip = BytesIO()
    Image.fromarray(np.concatenate(panels, axis=1)).save(strip, "WEBP", quality=STRIP_QUALITY, method=6)
    write_bytes(PICTURES / f"{person.scene}.webp", strip.getvalue())
    shots = [(k / FILM_FRAMES, OBLIQUE + k / FILM_FRAMES) for k in range(FILM_FRAMES)]
    pictures = [Image.fromarray(picture) for picture in around(folder, person.film, shots, FILM_SIZE)]
    film = BytesIO()
    pictures[0].save(
        film, "WEBP", save_all=True, append_images=pictures[1:], duration=100, loop=0,
        quality=FILM_QUALITY, method=4,
    )  # fmt: skip
    write_bytes(PICTURES / f"{person.scene}-{person.film}.webp", film.getvalue())


def cut(picture: Picture, frame: Frame) -> Picture:
    """Returns the square around the person, `SIZE` pixels; what lies outside of the picture is black."""
    assert frame.truth is not None
    ys, xs = np.nonzero(frame.truth.mask.numpy() > 0.5)
    side = MARGIN * max(np.ptp(ys), np.ptp(xs))
    x, y = 0.5 * (xs.min() + xs.max() + 1), 0.5 * (ys.min() + ys.max() + 1)
    scale = SIZE / side
    place = np.array([[scale, 0.0, 0.5 * SIZE - scale * x], [0.0, scale, 0.5 * SIZE - scale * y]])
    place[:, 2] += 0.5 * scale - 0.5  # pixel centres lie at +0.5
    return np.asarray(cv2.warpAffine(picture, place, (SIZE, SIZE), flags=cv2.INTER_CUBIC), np.uint8)


def around(
    folder: Path, motion: str | None, moments: list[tuple[float, float]], size: int = SIZE
) -> list[Picture]:
    """Returns pictures of an avatar from around it, framed as `render --path turntable` frames them.

    Args:
        folder: of the run.
        motion: which plays; None: the sequence's first frame stands.
        moments: which share of the motion each shows, and from which share of a turn.
        size: pixels.
    """
    loaded = load_run(folder)
    showing = make_showing(
        loaded, "turntable", MotionChoice(motion), size=(size, size), renderer=Renderer("auto")
    )
    performance = showing.painter.performance
    rows = [min(int(moment * len(performance)), len(performance) - 1) for moment, _ in moments]
    angles = [2 * math.pi * turn for _, turn in moments]
    framing = Framing(size, size, loaded.pixel)
    shots = orbit(performance, rows, angles, [RISE] * len(rows), framing)
    black = parse_background("black", size, size)
    return [picture_of(showing.painter.draw(shot), "rgb", black, None) for shot in shots]


def page(work: Path) -> str:
    """Returns the page, with the figures of the runs."""
    parts = [HEAD]
    for person in PEOPLE:
        metrics = json.loads(RunFolder(work / person.scene).metrics.read_text(encoding="utf-8"))
        full, box = metrics["regions"]["full"], metrics["regions"]["box"]
        name = f"pictures/gallery/{person.scene}"
        figures = (
            f"Held-out cameras, {metrics['images']} images: PSNR {full['psnr']:.2f} dB, SSIM {full['ssim']:.4f}, in the"
            f" person's box\n{box['psnr']:.2f} dB. {metrics['gaussians']} Gaussians."
        )
        parts.append(
            f"## {person.scene}\n\n{person.text}. {figures}\n\n"
            f"![{person.scene}: input, avatar, from behind, other motions]({name}.webp)\n\n"
            f"![{person.scene} plays {person.film}]({name}-{person.film}.webp)\n"
        )
    return "\n".join(parts)


if __name__ == "__main__":
    main()
