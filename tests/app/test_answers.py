"""Answers in other skeletons, joint by joint."""

import numpy as np
import pytest

from app.answers import wording_in
from library_store.skeleton import LSP14

NECK, HEAD_TOP, R_HIP = (LSP14.index(name) for name in ("neck", "head_top", "r_hip"))


def named(values: list[float] | list[None] | np.ndarray) -> dict[str, float | bool | None]:
    return dict(zip(wording_in("h36m17").skeleton.joint_names, list(values), strict=True))


@pytest.mark.parametrize(
    ("missing", "gone"),
    [
        ((), set()),
        ((NECK,), {"spine", "thorax", "neck_base"}),
        ((HEAD_TOP,), {"head", "neck_base"}),
        ((R_HIP,), {"right_hip", "root", "spine"}),
    ],
)
def test_a_joint_is_there_when_all_that_it_is_made_of_are(
    missing: tuple[int, ...], gone: set[str]
) -> None:
    present = np.ones(14, bool)
    present[list(missing)] = False
    there = named(wording_in("h36m17").present(present))
    assert {name for name, is_there in there.items() if not is_there} == gone


def test_a_joint_is_as_sure_as_the_least_sure_that_it_is_made_of() -> None:
    confidence = np.linspace(0.3, 0.95, 14)
    sure = named(wording_in("h36m17").confidence(confidence))
    assert sure["right_hip"] == round(confidence[R_HIP], 3)
    assert sure["spine"] == round(min(confidence[[NECK, R_HIP, LSP14.index("l_hip")]]), 3)
    assert wording_in("h36m17").confidence(None) == [None] * 17


def test_a_joint_in_the_middle_is_no_less_sure_than_its_ends_on_the_mean() -> None:
    sigma = np.linspace(20.0, 90.0, 14)
    radius = named(wording_in("h36m17").sigma(sigma))
    assert radius["neck_base"] == pytest.approx((sigma[NECK] + sigma[HEAD_TOP]) / 2, abs=1e-3)
    assert wording_in("h36m17").sigma(None) == [None] * 17


def test_what_lsp14_does_not_determine_is_never_there() -> None:
    wording = wording_in("coco17")
    there = wording.present(np.ones(14, bool))
    faces = [
        n for n, is_there in zip(wording.skeleton.joint_names, there, strict=True) if not is_there
    ]
    assert faces == ["nose", "left_eye", "right_eye", "left_ear", "right_ear"]
