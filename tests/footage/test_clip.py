"""Clips are read upright, at a bounded size, and what is wrong with them is named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from occfusion.errors import ConfigError, DataError
from occfusion.files.video import write_frames
from occfusion.footage.camera import find_intrinsics, focal_on_film
from occfusion.footage.clip import chosen, combing, cuts, open_clip, read_clip


def moving(count: int, seed: int = 0, shape: tuple[int, int] = (96, 128)) -> list[np.ndarray]:
    """Returns pictures of a textured scene that slides by a pixel a frame."""
    rng = np.random.default_rng(seed)
    wide = cv2.resize(rng.uniform(0, 255, (16, 48, 3)).astype(np.uint8), (shape[1] + count, shape[0]))
    return [np.ascontiguousarray(wide[:, k : k + shape[1]]) for k in range(count)]


def test_frames_are_chosen_by_step_count_and_range(tmp_path):
    write_frames(tmp_path / "clip.mp4", moving(40), fps=10)
    clip = open_clip(tmp_path / "clip.mp4")
    assert clip.frames == 40 and clip.fps == pytest.approx(10)
    assert read_clip(clip, every=7, start=3).numbers == [3, 10, 17, 24, 31, 38]
    assert read_clip(clip, frames=3).numbers == [0, 20, 39]
    shot = read_clip(clip, stop=5)
    np.testing.assert_allclose(np.diff(shot.seconds), 0.1, atol=1e-3)


def test_frames_are_counted_where_the_container_does_not_say_how_many(tmp_path):
    """As in what a browser records: its header was written before the end was known."""
    writer = cv2.VideoWriter(str(tmp_path / "whole.mkv"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (128, 96))
    for picture in moving(40):
        writer.write(picture)
    writer.release()
    content = (tmp_path / "whole.mkv").read_bytes()
    duration = content.index(b"\x44\x89\x88")  # Matroska's id, and eight bytes
    void = b"\xec\x89" + bytes(9)
    (tmp_path / "clip.mkv").write_bytes(content[:duration] + void + content[duration + len(void) :])
    clip = open_clip(tmp_path / "clip.mkv")
    assert clip.frames == 40
    assert read_clip(clip, frames=3).numbers == [0, 20, 39]


def test_fast_clips_are_thinned_and_large_ones_made_smaller_and_both_is_said(tmp_path):
    write_frames(tmp_path / "clip.mp4", moving(24, shape=(200, 400)), fps=120)
    shot = read_clip(open_clip(tmp_path / "clip.mp4"), side=200)
    assert shot.numbers == [0, 4, 8, 12, 16, 20]
    assert shot.size == (200, 100) and shot.scale == 0.5
    assert any("120 frames a second" in note for note in shot.notes)
    assert any("200 x 100" in note for note in shot.notes)


def test_folders_are_read_in_natural_order_and_turned_as_exif_says(tmp_path):
    pictures = moving(11)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"frame{k}.png"), picture[..., ::-1])
    shot = read_clip(open_clip(tmp_path))
    for read, written in zip(shot.pictures, pictures, strict=True):
        np.testing.assert_array_equal(read, written)


def test_a_cut_is_found_and_motion_is_none():
    one, other = moving(12), moving(12, seed=5)
    assert cuts(one) == []
    assert cuts([*one, *[255 - p // 3 for p in other]]) == [12]
    # the sun bursts into the lens: all colours change, and nothing moves
    assert cuts([p if k < 6 else 120 + p // 2 for k, p in enumerate(one)]) == []


def test_the_sharpest_and_the_least_alike_are_chosen():
    pictures = [
        cv2.GaussianBlur(p, (0, 0), 0.1 if k in (2, 5, 10) else 3.0) for k, p in enumerate(moving(12))
    ]
    assert chosen(pictures, 3, "sharpest") == [2, 5, 10]
    one, other = moving(12)[0], moving(12, seed=5)[0]
    pictures = [one, one, one, other, other, 255 - one]
    assert chosen(pictures, 3, "unlike") in ([0, 3, 5], [0, 4, 5])
    assert chosen(pictures, 9, "unlike") == list(range(6))


def test_interlaced_rows_are_told_from_texture():
    first, _, _, _, _, later = moving(6)
    woven = first.copy()
    woven[1::2] = moving(20)[19][1::2]
    assert combing(woven) > 1.6 > combing(first)
    assert combing(later) < 1.6


@pytest.mark.parametrize("content", [b"", b"no video at all", b"\0\0\0\x18ftypmp42" + bytes(200)])
def test_what_is_no_video_is_refused(tmp_path, content):
    (tmp_path / "clip.mp4").write_bytes(content)
    with pytest.raises(DataError, match=r"clip\.mp4"):
        read_clip(open_clip(tmp_path / "clip.mp4"))


def test_a_clip_cut_short_gives_what_is_whole_or_is_refused(tmp_path):
    write_frames(tmp_path / "clip.avi", moving(30), fps=10)
    content = (tmp_path / "clip.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) // 2])
    shot = read_clip(open_clip(tmp_path / "cut.avi"))
    assert 5 < len(shot) < 30


def test_still_pictures_missing_files_and_wrong_choices_are_named(tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), moving(1)[0])
    with pytest.raises(DataError, match="one picture"):
        open_clip(tmp_path / "one.png")
    with pytest.raises(DataError, match="no such file"):
        open_clip(tmp_path / "none.mp4")
    with pytest.raises(ConfigError):
        read_clip(open_clip(tmp_path), start=4)


def test_the_focal_length_of_exif_is_used(tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(moving(1)[0]).save(tmp_path / "a.jpg", exif=exif)
    assert focal_on_film(tmp_path / "a.jpg") == 28
    lens = find_intrinsics((128, 96), 1.0, None, tmp_path / "a.jpg")
    assert lens.known and lens.K[0, 0] == pytest.approx(28 / 36 * 128)
    assert not find_intrinsics((128, 96), 1.0, None, None).known
    with pytest.raises(ConfigError, match="focal"):
        find_intrinsics((128, 96), 1.0, 1e6, None)
