"""Several people in a picture: the wanted one by number, the others as occluders where they can hide them."""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.data.silhouette import who_can_hide
from occfusion.data.video.video_data import VideoDataModule
from occfusion.errors import ConfigError, DataError
from occfusion.evaluation.evaluate import evaluate_image
from occfusion.observation.frames import observe_frames
from occfusion.run.init import make_prior
from occfusion.synth import SceneSpec, write_scene
from occfusion.types import Rendering

SIZE, FRAMES = 96, 4
ME, OTHER = 3, 5


def blob(*windows: tuple[int, int, int, int]) -> np.ndarray:
    mask = np.zeros((60, 60), bool)
    for top, bottom, left, right in windows:
        mask[top:bottom, left:right] = True
    return mask


def test_who_touches_can_hide_and_who_stands_apart_cannot():
    person = blob((10, 50, 10, 20))
    beside, far = blob((20, 30, 20, 25)), blob((0, 60, 40, 45))
    np.testing.assert_array_equal(who_can_hide(person, beside | far), beside)
    rim = blob((20, 30, 22, 25))  # two unlabelled columns between them
    np.testing.assert_array_equal(who_can_hide(person, rim | far), rim)
    assert not who_can_hide(person, blob((20, 30, 23, 25))).any()
    chain = beside | blob((25, 27, 25, 41)) | far  # one who touches somebody who touches the person
    np.testing.assert_array_equal(who_can_hide(person, chain), chain)
    assert not who_can_hide(np.zeros_like(person), far).any()
    assert not who_can_hide(person, np.zeros_like(person)).any()


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=2)
    return Source(write_scene(tmp_path_factory.mktemp("people"), spec, progress=False))


@pytest.fixture(scope="module")
def crowd(source, tmp_path_factory) -> Path:
    """Frame 0: somebody before the person's lower half. 1: somebody far away. 2: alone. 3: both."""
    folder = writers.write_video(source, tmp_path_factory.mktemp("video") / "crowd")
    for frame, path in enumerate(sorted((folder / "masks").iterdir())):
        person = source.mask(frame) > 0
        numbers = person * np.uint8(ME)
        if frame in (0, 3):
            numbers[other(person)] = OTHER
        if frame in (1, 3):
            assert not person[:, :4].any()
            numbers[:, :2] = OTHER + 1
        cv2.imwrite(str(path), numbers)
    return folder


def other(person: np.ndarray) -> np.ndarray:
    """A square over the lower half of a person, wider than they are."""
    rows, columns = np.nonzero(person)
    mask = np.zeros_like(person)
    mask[(rows.min() + rows.max()) // 2 : rows.max() + 3, columns.min() - 6 : columns.max() + 6] = True
    return mask


def module(folder: Path, source: Source, **settings) -> VideoDataModule:
    settings = {"person": ME, "occluded": False, **settings}
    return VideoDataModule(folder.parent, folder.name, source.body, image_size=SIZE, **settings)


def test_others_are_marked_where_they_can_hide_the_person(crowd, source):
    data = module(crowd, source)
    data.validate()
    for frame in data.train_frames():
        person = source.mask(frame.index) > 0
        hiding = other(person) if frame.index in (0, 3) else np.zeros_like(person)
        np.testing.assert_array_equal(frame.visible_mask.numpy(), person & ~hiding)
        np.testing.assert_array_equal(frame.occluded.numpy(), hiding)
        assert (frame.truth is None) == bool(hiding.any())  # nobody knows what is behind them
        assert frame.rgb[~frame.visible_mask].abs().max() == 0
    assert data.train_frame(0, truth=False).occluded is None  # training is not told


def test_others_are_marked_beside_what_is_simulated(crowd, source):
    strip = {"kind": "strip", "mid": 512, "width": 60, "fraction": 1.0}
    for index in (0, 2):
        plain, hidden = (module(crowd, source, occlusion=kind).train_frame(index) for kind in ("none", strip))
        columns = hidden.occluded.all(dim=0)
        assert 4 <= columns.sum() <= 8
        assert torch.equal(hidden.occluded, plain.occluded | columns[None])
        assert torch.equal(hidden.visible_mask, plain.visible_mask & ~columns[None])


def test_how_much_others_hide_is_estimated(crowd, source):
    summary = module(crowd, source).summary()
    shares = list(summary["visible_share"].values())
    assert summary["visible_share_is"] == "estimated" and summary["occluded_frames"] == 2
    assert shares[1:3] == [1.0, 1.0] and max(shares[0], shares[3]) < 0.75
    assert module(crowd, source, train_frames=[1, 3, 1]).summary()["visible_share_is"] == "known"


def test_behind_others_nothing_is_held_against_the_avatar(crowd, source):
    frame = module(crowd, source).train_frame(0)
    person = torch.from_numpy(source.mask(0) > 0)
    alpha = person.float()  # the whole person, as a good avatar shows them
    rendering = Rendering(frame.rgb, alpha, alpha, torch.zeros(0, 2))
    rows = {row.region: row for row in evaluate_image(rendering, frame, ("full", "visible", "hidden"), None)}
    assert rows["visible"].mask_iou == 1.0 and rows["visible"].psnr == 100.0
    assert rows["full"].pixels == rows["hidden"].pixels == 0
    held_out = module(crowd, source, test_cameras=[0], test_frames=[0, 4, 1], train_frames=[1, 3, 1])
    assert [held_out.test_frame(k, 0).truth is None for k in range(4)] == [True, False, False, True]


def test_where_anything_may_stand_before_the_person_others_are_found_as_any_occluder(crowd, source):
    data = module(crowd, source, occluded=True)
    frames = [data.train_frame(k) for k in range(FRAMES)]
    assert all(frame.occluded is None and frame.truth is None for frame in frames)
    observed_frames = observe_frames(frames.__getitem__, range(len(frames)), source.body)
    assert [observed_frame.evidence.occluded for observed_frame in observed_frames] == [
        True,
        False,
        False,
        True,
    ]
    hiding, hidden = other(source.mask(0) > 0), observed_frames[0].evidence.hidden
    assert hidden.sum() > 20 and (hidden & hiding).sum() > 0.95 * hidden.sum()


def test_true_masks_are_not_claimed_where_others_hide(crowd, source):
    class Settings:
        class init:
            source = "truth"

    with pytest.raises(ConfigError, match=r"does not know what is hidden in image_0001"):
        make_prior(Settings, module(crowd, source), torch.device("cpu"))
    prior = make_prior(Settings, module(crowd, source, train_frames=[1, 3, 1]), torch.device("cpu"))
    assert prior.describe() == {"prior": "truth"}


def test_a_number_that_no_mask_has(crowd, source):
    with pytest.raises(
        DataError, match=r"mask_0001\.png: no person 9 in this mask, which has the values 3, 5"
    ):
        module(crowd, source, person=9).validate()


def png(path: Path, rows: np.ndarray, bits: int, colour: int) -> None:
    """Writes grey (0) or palette (3) values with few bits, which OpenCV does not write."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    height, width = rows.shape
    bit = np.unpackbits(rows[..., None].astype(np.uint8), axis=2)[..., 8 - bits :].reshape(height, -1)
    lines = b"".join(b"\0" + np.packbits(line).tobytes() for line in bit)
    parts = [chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))]
    if colour == 3:
        parts.append(chunk(b"PLTE", bytes(range(255, 255 - 3 * 4, -1))))
        parts.append(chunk(b"tRNS", b"\0\x80"))
    parts += [chunk(b"IDAT", zlib.compress(lines)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.mark.parametrize("colour", [0, 3])
@pytest.mark.parametrize("bits", [2, 4, 8])
def test_numbers_are_read_as_they_are_stored(bits, colour, tmp_path):
    from occfusion.files.images import read_numbers

    numbers = np.random.default_rng(0).integers(0, 4, (7, 13))
    png(tmp_path / "m.png", numbers, bits, colour)
    np.testing.assert_array_equal(read_numbers(tmp_path / "m.png"), numbers)
    assert cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED) is not None  # others can read it as well


def test_numbers_of_16_bits_and_three_equal_channels(tmp_path):
    from occfusion.files.images import read_numbers

    large = np.array([[0, 300], [7, 65535]], np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), large)
    np.testing.assert_array_equal(read_numbers(tmp_path / "a.png"), large)
    small = np.array([[0, 30], [7, 255]], np.uint8)
    cv2.imwrite(str(tmp_path / "b.png"), np.repeat(small[..., None], 3, axis=2))
    np.testing.assert_array_equal(read_numbers(tmp_path / "b.png"), small)


def test_what_cannot_number_people_is_refused(tmp_path):
    from occfusion.files.images import read_numbers

    cv2.imwrite(str(tmp_path / "a.jpg"), np.full((8, 8), 3, np.uint8))
    with pytest.raises(DataError, match=r"a\.jpg: a JPEG cannot number people"):
        read_numbers(tmp_path / "a.jpg")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((8, 8, 3), (0, 0, 3), np.uint8))
    with pytest.raises(DataError, match=r"a\.png: colours do not number people"):
        read_numbers(tmp_path / "a.png")


def test_palette_masks_of_annotation_tools(crowd, source, tmp_path):
    folder = Path(shutil.copytree(crowd, tmp_path / "palette"))
    for path in (folder / "masks").iterdir():
        numbers = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        png(path, np.minimum(numbers, 3) * (numbers == ME) + (numbers > ME), 8, 3)
    a, b = module(crowd, source), module(folder, source)
    for frame in range(FRAMES):
        assert torch.equal(a.train_frame(frame).visible_mask, b.train_frame(frame).visible_mask)
        assert torch.equal(a.train_frame(frame).occluded, b.train_frame(frame).occluded)
