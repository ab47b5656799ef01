"""Who trains on which pictures of PeopleSnapshot and NeuMan: InstantAvatar's settings, by subject.

Read in `confs/dataset/` of tijiang13/InstantAvatar. Its `end` belongs to the range (`start:end + 1:skip`); stops
here do not. Where its program does otherwise than one would think:

- its evaluation first fits the poses of the held-out pictures to those very pictures, the avatar frozen
  (`eval.py`), so that its figures are those of poses that have seen the answer; here held-out poses are used
  as they are stored;
- PeopleSnapshot is trained and measured at half size, 540 px (`dataset.image_size=540`), on a white ground;
- halving the pictures without moving the principal point shifts its rays by another half of a stored pixel;
- `seattle` holds out pictures 40 and 41, on which it also trains;
- `male-2-*` hold out every twentieth picture from the stretch that they train on;
- `female-4-casual` trains to picture 332 and holds out from 335.
"""

from __future__ import annotations

from dataclasses import dataclass

from occfusion.errors import ConfigError

PROTOCOLS = ("instantavatar",)


@dataclass(frozen=True)
class Ranges:
    """Pictures by their place in the folder, from 0.

    Attributes:
        train: trained on.
        test: held out.
    """

    train: range
    test: range


INSTANT_AVATAR = {
    "male-3-casual": Ranges(range(0, 456, 4), range(456, 676, 4)),
    "male-4-casual": Ranges(range(0, 660, 6), range(660, 873, 6)),
    "female-3-casual": Ranges(range(0, 446, 4), range(446, 648, 4)),
    "female-4-casual": Ranges(range(0, 336, 4), range(335, 524, 4)),
    "male-2-casual": Ranges(range(1, 456, 4), range(1, 456, 20)),
    "male-2-sport": Ranges(range(1, 456, 4), range(1, 456, 20)),
    "male-3-sport": Ranges(range(1, 231, 2), range(230, 461, 6)),
    "female-4-sport": Ranges(range(1, 337, 4), range(336, 525, 4)),
    "seattle": Ranges(range(0, 42, 1), range(40, 42, 4)),
}
"""By the name of the folder; the last is NeuMan's, the others are PeopleSnapshot's."""


def find_ranges(protocol: str | None, subject: str) -> Ranges | None:
    """Returns the pictures of a protocol for a subject, None where no protocol is asked for.

    Raises:
        ConfigError: no such protocol, or it says nothing of the subject.
    """
    if protocol is None:
        return None
    if protocol not in PROTOCOLS:
        raise ConfigError(f"dataset.protocol={protocol!r}: choose {', '.join(PROTOCOLS)}, or null.")
    if subject not in INSTANT_AVATAR:
        raise ConfigError(
            f"dataset.protocol={protocol}: says nothing of {subject!r}, only of {', '.join(INSTANT_AVATAR)}. Name the "
            "folder so, or give dataset.train_frames and dataset.test_frames."
        )
    return INSTANT_AVATAR[subject]
