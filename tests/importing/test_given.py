"""Key points, masks and cameras of other tools, written here as the tools write them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from occfusion.errors import ConfigError, DataError
from occfusion.files.video import write_frames
from occfusion.footage.clip import Clip, Shot
from occfusion.footage.landmarks import INDEX
from occfusion.importing.cameras import read_intrinsics
from occfusion.importing.keypoints import ORDERS, read_keypoints
from occfusion.importing.masks import decode, read_masks

WIDTH, HEIGHT, FRAMES = 64, 48, 6


@pytest.fixture
def clip(tmp_path):
    return Clip(tmp_path / "clip.mp4", (), FRAMES, 10.0, 0)


@pytest.fixture
def shot():
    """Returns every second frame of a clip, at half its size."""
    numbers = [0, 2, 4]
    pictures = [np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8)] * 3
    return Shot(pictures, numbers, [k / 10 for k in numbers], 0.5, [])


def body(points: int, x: float) -> list[float]:
    """Returns a person's flat list; the k-th point at x + k / 10, y = k."""
    return [value for k in range(points) for value in (x + k / 10, float(k % 40), 0.9)]


def expect(found, order: int, x: float) -> None:
    """Asserts that the first picture's points lie where the order says, at half size, a half pixel on."""
    names = ORDERS[order]
    for k, name in enumerate(names):
        if name:
            place = [(x + k / 10 + 0.5) / 2, (k % 40 + 0.5) / 2]
            np.testing.assert_allclose(found.pixels[0, INDEX[name]], place, err_msg=name)
            assert found.confidence[0, INDEX[name]] == pytest.approx(0.9)
    assert (found.confidence[0] > 0).sum() == len([name for name in names if name])


@pytest.mark.parametrize("points", [25, 18])
def test_openpose(tmp_path, clip, shot, points):
    """`--write_json`: `VIDEO_000000000000_keypoints.json` with `people`; CMU-Perceptual-Computing-Lab/openpose
    `doc/02_output.md@75354344` (in both orders 1 is the neck, 2 the right shoulder, 5 the left)."""
    for k in range(FRAMES):
        people = [{"person_id": [-1], "pose_keypoints_2d": body(points, 5.0 + k)}]
        people += [{"person_id": [-1], "pose_keypoints_2d": [0.0] * 3 * points}]
        content = {"version": 1.3, "people": [] if k == 2 else people}
        (tmp_path / f"clip_{k:012d}_keypoints.json").write_text(json.dumps(content))
    found = read_keypoints(tmp_path, clip, shot)
    expect(found, points, 5.0)
    assert list(found.presence) == [1, 0, 1] and found.world is None
    right = ORDERS[points].index("right_shoulder")
    assert right == 2 and ORDERS[points][5] == "left_shoulder"


@pytest.mark.parametrize("points", [17, 26, 136])
def test_alphapose_and_coco_follow_one_of_two_people(tmp_path, clip, shot, points):
    """`write_json(..., for_eval=False)`: MVIG-SJTU/AlphaPose `alphapose/utils/pPose_nms.py@00e180e1`; Halpe's order:
    Fang-Haoshu/Halpe-FullBody `README.md` (20, 21 big toes, 24, 25 heels)."""
    rows = []
    for k in range(FRAMES):
        for x in (30.0, 5.0)[:: 1 if k % 4 else -1]:
            rows.append({"image_id": f"{k}.jpg", "category_id": 1, "keypoints": body(points, x), "score": 2.9,
                         "box": [0, 0, 5, 5], "idx": [0.0]})  # fmt: skip
    for row in rows:
        row.pop("idx")
    (tmp_path / "alphapose-results.json").write_text(json.dumps(rows))
    for person, x in ((1, 5.0), (2, 30.0)):
        found = read_keypoints(tmp_path / "alphapose-results.json", clip, shot, person)
        expect(found, points, x)
        assert np.ptp(found.pixels[:, INDEX["nose"], 0]) == 0
    with pytest.raises(ConfigError, match="has 2 in a frame"):
        read_keypoints(tmp_path / "alphapose-results.json", clip, shot, 3)


def test_a_tracker_s_number_outweighs_the_place(tmp_path, clip, shot):
    """`result['idx']` is PoseFlow's number: same file of AlphaPose."""
    rows = [
        {"image_id": f"{k}.jpg", "keypoints": body(17, 5.0 if (idx == 1) == (k < 3) else 30.0), "idx": idx}
        for k in range(FRAMES) for idx in (1, 2)
    ]  # fmt: skip
    (tmp_path / "r.json").write_text(json.dumps(rows))
    found = read_keypoints(tmp_path / "r.json", clip, shot, 1)
    np.testing.assert_allclose(found.pixels[:, INDEX["nose"], 0], [2.75, 2.75, 15.25])


@pytest.mark.parametrize("form", ["web", "python", "legacy"])
def test_mediapipe(tmp_path, clip, shot, form):
    """`PoseLandmarkerResult`, as JSON.stringify writes the web's (google-ai-edge/mediapipe
    `mediapipe/tasks/web/vision/pose_landmarker/pose_landmarker_result.d.ts`), as a dict the Python one's
    (`mediapipe/tasks/python/vision/pose_landmarker.py`), and MessageToDict the old solution's."""
    marks = [{"x": 0.5, "y": 0.01 * k, "z": 0.0, "visibility": 0.8} for k in range(33)]
    world = [{"x": 0.1, "y": 0.01 * k, "z": -0.2, "visibility": 0.8} for k in range(33)]
    row = {
        "web": {"landmarks": [marks], "worldLandmarks": [world]},
        "python": {"pose_landmarks": [marks], "pose_world_landmarks": [world], "segmentation_masks": None},
        "legacy": {"landmark": marks},
    }[form]
    (tmp_path / "poses.json").write_text(json.dumps([row] * FRAMES))
    found = read_keypoints(tmp_path / "poses.json", clip, shot)
    np.testing.assert_allclose(found.pixels[1, 5], [WIDTH / 4, 0.05 * HEIGHT / 2])
    assert (found.world is None) is (form == "legacy")
    assert found.world is None or found.world[0, 5] == pytest.approx([0.1, 0.05, -0.2])


def square(frame: int, person: int = 1) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:30, 4 + frame + 20 * (person - 1) : 14 + frame + 20 * (person - 1)] = True
    return mask


def same(found, person: int = 1) -> None:
    for mask, number in zip(found, [0, 2, 4], strict=True):
        assert mask.shape == (HEIGHT // 2, WIDTH // 2)
        np.testing.assert_array_equal(mask, square(number, person)[::2, ::2])


def test_sam_2_numbers_people_in_a_palette_or_in_folders(tmp_path, clip, shot):
    """`save_masks_to_dir`: palette PNG of numbers, or `OBJECT/FRAME.png` of 0 and 1; facebookresearch/sam2
    `tools/vos_inference.py@2b90b9f5`."""
    from PIL import Image

    for k in range(FRAMES):
        picture = Image.fromarray((square(k) + 2 * square(k, 2)).astype(np.uint8))
        picture.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
        (tmp_path / "packed").mkdir(exist_ok=True)
        picture.save(tmp_path / "packed" / f"{k:05d}.png")
        for person in (1, 2):
            folder = tmp_path / "apart" / f"{person:03d}"
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray(square(k, person).astype(np.uint8)).save(folder / f"{k:05d}.png")
    for name in ("packed", "apart"):
        for person in (1, 2):
            same(read_masks(tmp_path / name, clip, shot, person), person)
        with pytest.raises(DataError, match="--masks-person"):
            read_masks(tmp_path / name, clip, shot)


def encoded(mask: np.ndarray) -> dict:
    """COCO's compressed run lengths, by its rules (cocodataset/cocoapi `common/maskApi.c` rleToString)."""
    flat = mask.T.reshape(-1).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flat]))).tolist()
    counts = np.diff([0, *edges, flat.size]).tolist()
    letters = ""
    for k, count in enumerate(counts):
        value, more = count - (counts[k - 2] if k > 2 else 0), True
        while more:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            letters += chr(48 + (bits | 32 if more else bits))
    return {"size": list(mask.shape), "counts": letters}


def test_run_lengths_of_coco_and_of_sa_v(tmp_path, clip, shot):
    """`{"image_id", "category_id", "segmentation": RLE, "score"}`, and SA-V's `masklet`, a list of objects a frame
    (facebookresearch/sam2 `sav_dataset/README.md`)."""
    rng = np.random.default_rng(0)
    for mask in (square(3), rng.random((13, 7)) < 0.5, rng.random((90, 70)) < 0.01, np.ones((4, 5), bool)):
        np.testing.assert_array_equal(decode(encoded(mask), "x"), mask)
    plain = {"size": [2, 3], "counts": [1, 2, 3]}
    np.testing.assert_array_equal(decode(plain, "x"), [[0, 1, 0], [1, 0, 0]])
    rows = [{"image_id": k, "category_id": 1, "segmentation": encoded(square(k))} for k in range(FRAMES)]
    (tmp_path / "coco.json").write_text(json.dumps(rows))
    same(read_masks(tmp_path / "coco.json", clip, shot))
    masklet = [[encoded(square(k)), encoded(square(k, 2))] for k in range(FRAMES)]
    (tmp_path / "sav.json").write_text(json.dumps({"masklet": masklet}))
    same(read_masks(tmp_path / "sav.json", clip, shot, 2), 2)
    with pytest.raises(DataError, match="run lengths"):
        decode({"size": [3, 3], "counts": [1, 2, 3]}, "x")


def test_pictures_with_alpha_and_videos_of_mattes(tmp_path, clip, shot):
    (tmp_path / "alpha").mkdir()
    for k in range(FRAMES):
        picture = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
        picture[..., 3] = 255 * square(k)
        cv2.imwrite(str(tmp_path / "alpha" / f"{k:03d}.png"), picture)
    same(read_masks(tmp_path / "alpha", clip, shot))
    mattes = [np.repeat(255 * square(k).astype(np.uint8)[..., None], 3, axis=2) for k in range(FRAMES)]
    write_frames(tmp_path / "pha.avi", mattes, fps=10)
    for mask, number in zip(read_masks(tmp_path / "pha.avi", clip, shot), [0, 2, 4], strict=True):
        assert (mask != square(number)[::2, ::2]).mean() < 0.02


def test_rows_of_another_clip_are_refused(tmp_path, clip, shot):
    for k in range(FRAMES + 3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), 255 * square(0).astype(np.uint8))
    with pytest.raises(DataError, match="9 frames"):
        read_masks(tmp_path, clip, shot)
    (tmp_path / "k.json").write_text(json.dumps([{"image_id": "0.jpg", "keypoints": body(17, 500.0)}]))
    with pytest.raises(DataError, match="outside"):
        read_keypoints(tmp_path / "k.json", clip, shot)
    (tmp_path / "k.json").write_text(json.dumps([{"image_id": "0.jpg", "keypoints": body(19, 5.0)}]))
    with pytest.raises(DataError, match="19 key points"):
        read_keypoints(tmp_path / "k.json", clip, shot)


def test_people_of_mmpose_without_scores_are_refused(tmp_path, clip, shot):
    """open-mmlab/mmpose `mmpose/structures/utils.py` split_instances writes both."""
    rows17 = np.reshape(body(17, 5.0), (17, 3))
    whole = {"keypoints": rows17[:, :2].tolist(), "keypoint_scores": rows17[:, 2].tolist()}
    rows = [{"frame_id": k, "instances": [whole]} for k in range(FRAMES)]
    (tmp_path / "k.json").write_text(json.dumps({"instance_info": rows}))
    assert read_keypoints(tmp_path / "k.json", clip, shot).presence.all()
    rows[1]["instances"] = [{"keypoints": whole["keypoints"]}]
    (tmp_path / "k.json").write_text(json.dumps({"instance_info": rows}))
    with pytest.raises(DataError, match=r"keypoint_scores"):
        read_keypoints(tmp_path / "k.json", clip, shot)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        # nerfstudio-project/nerfstudio `nerfstudio/process_data/colmap_utils.py@084f7259` parse_colmap_camera_params
        ("transforms.json", {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 52.0, "cx": 33.0, "cy": 24.0, "frames": []}),
        ("transforms.json", {"w": 64, "h": 48, "frames": [{"fl_x": 50.0, "fl_y": 52.0, "cx": 33.0, "cy": 24.0}]}),
        ("k.json", {"fx": 50.0, "fy": 52.0, "cx": 32.5, "cy": 23.5}),
        ("k.json", {"camera_matrix": [[50.0, 0, 32.5], [0, 52.0, 23.5], [0, 0, 1]]}),
        # isl-org/Open3D `cpp/open3d/camera/PinholeCameraIntrinsic.cpp` ConvertToJsonValue: column by column
        ("k.json", {"width": 64, "height": 48, "intrinsic_matrix": [50.0, 0, 0, 0, 52.0, 0, 32.5, 23.5, 1]}),
        # colmap/colmap `doc/format.rst`
        ("cameras.txt", "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE 64 48 50 52 33 24\n"),
    ],
)  # fmt: skip
def test_cameras(tmp_path, shot, name, content):
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    camera, notes = read_intrinsics(tmp_path / name, shot)
    np.testing.assert_allclose(camera.K, [[25, 0, 16.5], [0, 26, 12], [0, 0, 1]])
    assert camera.known and not notes


def test_cameras_that_do_not_fit_are_refused_and_lenses_said(tmp_path, shot):
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n")
    camera, notes = read_intrinsics(tmp_path, shot)
    assert camera.K[0, 0] == 25 and "lens" in notes[0]
    (tmp_path / "cameras.txt").write_text("1 THIN_PRISM 640 480 500 320 240 -0.1\n")
    with pytest.raises(DataError, match="line 1"):
        read_intrinsics(tmp_path, shot)
    (tmp_path / "k.json").write_text(json.dumps({"w": 48, "h": 64, "fl_x": 50.0}))
    with pytest.raises(DataError, match="shape"):
        read_intrinsics(tmp_path / "k.json", shot)
    (tmp_path / "k.json").write_text(json.dumps({"focal": 5}))
    with pytest.raises(DataError, match="none of fl_x"):
        read_intrinsics(tmp_path / "k.json", shot)
