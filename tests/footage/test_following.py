"""Following one person: what is refused, with the frame and what to do. The models are played by a script."""

from __future__ import annotations

import numpy as np
import pytest

from occfusion.errors import ConfigError, DataError
from occfusion.footage import people
from occfusion.footage.blazepose import Detection, Region, Sighting
from occfusion.footage.landmarks import COUNT, INDEX
from occfusion.footage.people import follow

SIZE = 400


def played(monkeypatch, script, upside_down=False) -> list[np.ndarray]:
    """Returns pictures that hold their own number; the models see the people `(x, side)` that the script has there."""

    def there(picture):
        return [Region(x, 200.0, side, 0.0) for x, side in script[int(picture[0, 0, 0])]]

    class Landmarker:
        def __call__(self, picture, region):
            near = [one for one in there(picture) if abs(one.x - region.x) < 0.3 * region.side]
            pixels = np.tile([region.x, 200.0], (COUNT, 1))
            pixels[:, 0] += np.linspace(-10, 10, COUNT)
            pixels[:, 1] += np.linspace(-0.4, 0.4, COUNT) * region.side
            pixels[INDEX["nose"], 1] = 200 + (90 if upside_down else -90)
            pixels[[INDEX["left_ankle"], INDEX["right_ankle"]], 1] = 200 - (80 if upside_down else -80)
            part = near[0] if near else region
            mask = np.zeros((8, 8), np.float32)
            return Sighting(
                0.9 if near else 0.1, pixels, np.ones(COUNT), np.zeros((COUNT, 3)), mask, part, part
            )

    monkeypatch.setattr(people, "Landmarker", Landmarker)
    monkeypatch.setattr(
        people, "Detector", lambda: lambda picture: [Detection(0.9, one) for one in there(picture)]
    )
    return [np.full((SIZE, SIZE, 3), k, np.uint8) for k in range(len(script))]


def test_a_person_is_followed_and_gaps_are_told(monkeypatch):
    script = [[(150 + 2 * k, 100.0)] for k in range(20)]
    script[7] = script[8] = []
    track = follow(played(monkeypatch, script), range(20))
    assert [k for k, sighting in enumerate(track.sightings) if sighting is None] == [7, 8]
    assert "not seen in 2 frames (7-8)" in track.notes[0]


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ([[]] * 12, "nobody was found in the frames 0, 1"),
        ([[(200.0, 100.0)]] * 4 + [[]] * 16, r"only 4 of 20 frames \(0-3\).*--start 0 --stop 4"),
        ([[(100.0, 100.0), (300.0, 90.0)]] * 12, "2 people are in frame .*1 at x=100.*--person 1 to 2"),
        ([[(80.0, 90.0)]] * 9 + [[(320.0, 90.0)]] * 11, "frames 8 and 9: somebody else.*--start 9 --stop 20"),
    ],
)
def test_what_is_not_one_person_is_refused(monkeypatch, script, message):
    with pytest.raises(DataError, match=message):
        follow(played(monkeypatch, script), range(len(script)))


def test_one_of_several_is_chosen_and_bystanders_are_told(monkeypatch):
    script = [[(100.0, 100.0), (300.0, 90.0)]] * 12
    track = follow(played(monkeypatch, script), range(12), person=2)
    assert all(sighting is not None and sighting.region.x == 300 for sighting in track.sightings)
    with pytest.raises(ConfigError, match="--person 3"):
        follow(played(monkeypatch, script), range(12), person=3)
    small = follow(played(monkeypatch, [[(100.0, 100.0), (300.0, 30.0)]] * 12), range(12))
    assert "by far the largest" in small.notes[0]


def test_a_video_that_stands_on_its_head_is_refused(monkeypatch):
    with pytest.raises(DataError, match="--rotate 180"):
        follow(played(monkeypatch, [[(200.0, 100.0)]] * 12, upside_down=True), range(12))
