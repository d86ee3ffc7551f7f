"""Changed photos show their people where the changed labels say; answers are counted as found."""

from __future__ import annotations

import numpy as np
import pytest

from app.lifting.types import NotLiftable
from app.pipeline import SeenPerson
from evaluation.robustness import CHANGES, Seen, Tally
from library_store.skeleton import LSP14


def marked() -> Seen:
    """A black photo with a square of its own grey about each joint, one joint unlabelled."""
    image = np.zeros((480, 640, 3), np.uint8)
    joints = np.array([[45.0 + 40 * j, 60.0 + 24 * j] for j in range(14)])
    for number, (x, y) in enumerate(joints.astype(int)):
        image[y - 12 : y + 13, x - 12 : x + 13] = 100 + 10 * number
    return Seen(image, joints, np.array([0.0] + 13 * [1.0]))


@pytest.mark.parametrize("name", CHANGES)
def test_labels_follow_their_pixels(name: str) -> None:
    before = marked()
    after = CHANGES[name](before)
    dark = {"a fifth of the light": 0.2, "twice the light": 2.0}.get(name, 1.0)
    names = list(LSP14.mirror) if name == "in the mirror" else range(14)
    for joint, (x, y) in zip(names, np.rint(after.joints_px).astype(int), strict=True):
        expected = min(255.0, dark * (100 + 10 * joint))
        # Noise of 25 is averaged; the smallest photo has two pixels and a half of each square.
        reach = 3 if after.image.shape[1] > 300 else 0
        around = after.image[y - reach : y + reach + 1, x - reach : x + reach + 1]
        assert abs(around.mean() - expected) < 30 * min(dark, 1.0)
    assert after.known.sum() == 13
    assert after.known[list(names).index(0)] == 0


def test_found_is_whoever_overlaps_by_half_and_pck_is_of_the_found() -> None:
    seen = marked()
    wanted = np.array([[0.0, 0.0, 100.0, 200.0]])

    def person(box: tuple[float, float, float, float], off_px: float) -> SeenPerson:
        joints = seen.joints_px + np.array([off_px, 0.0])
        nowhere = NotLiftable("too few joints")
        return SeenPerson(box, 0.9, joints, np.ones(14, bool), None, None, nowhere)

    tally = Tally()
    tally.add((), seen, wanted)
    tally.add((person((300, 0, 20, 20), 0),), seen, wanted)
    tally.add((person((300, 0, 20, 20), 0), person((0, 0, 100, 190), 500)), seen, wanted)
    tally.add((person((2, 2, 98, 190), 0),), seen, wanted)
    assert (tally.asked, tally.nobody, tally.found) == (4, 1, 2)
    assert (tally.right, tally.joints) == (13, 26)
    assert tally.row("x") == "| x | 25.0 | 50.0 | 50.0 |"
