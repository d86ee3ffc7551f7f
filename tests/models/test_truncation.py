from pathlib import Path

import cv2
import numpy as np
import pytest

from evaluation.renders import read_renders
from models.person_detector import PersonBox
from models.pose_estimator import PoseEstimator
from models.truncation import GROWTHS, beyond_edge, whole

WIDTH, HEIGHT = 400, 300
CLEARLY = GROWTHS[-1][0]
RENDERS = Path(__file__).parents[1] / "data" / "renders"


def box(x: float, y: float, width: float, height: float) -> PersonBox:
    return PersonBox(x, y, width, height, score=0.8)


def test_who_is_seen_clearly_or_ends_within_the_photo_stays() -> None:
    portrait = box(100, 20, 150, 270)
    assert whole(portrait, WIDTH, HEIGHT, CLEARLY) is None
    assert whole(portrait, WIDTH, HEIGHT, 0.1) is not None
    assert whole(box(150, 100, 60, 90), WIDTH, HEIGHT, 0.1) is None
    filling = box(5, 400, 390, 80)
    assert whole(filling, WIDTH, 1000, 0.1) is None, "cut off on both sides, or not at all"


def test_what_lies_beyond_the_edge() -> None:
    at = np.array([[0, 0], [-0.4, 299.4], [399.6, 10], [50, 299.6], [-0.6, 20], [30, -7]], float)
    assert beyond_edge(at, WIDTH, HEIGHT).tolist() == [False, False, True, True, True, True]


@pytest.mark.parametrize(
    ("seen", "beyond"),
    [
        (box(100, 20, 150, 270), "bottom"),
        (box(100, 0, 100, 120), "top"),
        (box(150, 110, 240, 70), "right"),
        (box(5, 110, 240, 70), "left"),
        (box(5, 100, 60, 90), "left"),
    ],
)
def test_boxes_grow_beyond_the_edge_the_more_the_less_is_believed(
    seen: PersonBox, beyond: str
) -> None:
    lengths = []
    for least, longer in GROWTHS:
        grown = whole(seen, WIDTH, HEIGHT, least - 0.01)
        assert grown is not None
        assert grown.score == seen.score
        across = beyond in {"left", "right"}
        size, before = (
            (grown.width_px, seen.width_px) if across else (grown.height_px, seen.height_px)
        )
        assert size == pytest.approx(longer * before)
        lengths.append(size)
        # The side within the photo stays where it was.
        if beyond in {"bottom", "right"}:
            assert (grown.x_px, grown.y_px) == (seen.x_px, seen.y_px)
        elif beyond == "top":
            assert grown.y_px + grown.height_px == pytest.approx(seen.y_px + seen.height_px)
        else:
            assert grown.x_px + grown.width_px == pytest.approx(seen.x_px + seen.width_px)
    assert lengths == sorted(lengths, reverse=True)


def test_portraits_are_read_as_well_as_whole_people() -> None:
    """Photos that end at the hips or waist: the joints there are, right to a fifth of the trunk."""
    estimator = PoseEstimator("cpm-int8")
    as_seen: list[float] = []
    grown: list[float] = []
    beyond: list[float] = []
    within: list[float] = []
    for render in read_renders(RENDERS):
        image, joints = cv2.imread(str(RENDERS / render.file)), render.joints_px
        assert image is not None
        neck, hips = joints[1, 1], joints[[8, 11], 1].mean()
        for end in (hips, 0.4 * neck + 0.6 * hips):
            photo = np.asarray(image[: int(end)], np.uint8)
            there = joints[:, 1] < len(photo) - 1
            (x, y), (width, height) = joints[there].min(0), np.ptp(joints[there], axis=0)
            # With more of the photo about the box nobody is taken to be cut off.
            margin = int(max(width, height))
            larger = cv2.copyMakeBorder(photo, *4 * (margin,), cv2.BORDER_CONSTANT)
            (alone,) = estimator.estimate(
                np.asarray(larger, np.uint8), [box(x + margin, y + margin, width, height)]
            )
            (found,) = estimator.estimate(photo, [box(x, y, width, height)])
            near = 0.2 * np.linalg.norm(joints[2] - joints[11])
            for shares, at in ((as_seen, alone.positions_px - margin), (grown, found.positions_px)):
                apart = np.linalg.norm(at - joints, axis=1)[there]
                shares.append(float((apart < near).mean()))
            assert found.confidence is not None
            outside = beyond_edge(found.positions_px, photo.shape[1], len(photo))
            beyond += found.confidence[outside].tolist()
            within += found.confidence[~outside].tolist()
    assert np.mean(as_seen) > 0.8
    assert np.mean(grown) > 0.85
    assert len(beyond) > 20
    assert np.mean(beyond) < 0.35, "where legs are that cannot be seen is a guess, and said to be"
    assert np.mean(within) > 0.65
