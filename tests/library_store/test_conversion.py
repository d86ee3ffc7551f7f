"""Conversions between lsp14 and other skeletons: geometry first, then missing joints."""

from __future__ import annotations

import numpy as np
import pytest

from library_store.conversion import CONVERSIONS, GUESS, NECK_TO_EARS, Conversion
from library_store.skeleton import HEAD_TOP, LSP14, NECK

NAMES = sorted(CONVERSIONS)
SIZES = {"lsp14": 14, "coco17": 17, "h36m17": 17, "openpose18": 18, "mediapipe33": 33}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def affine_map(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(size=(3, 3)), rng.normal(size=3)


@pytest.mark.parametrize("name", NAMES)
def test_sizes_mirrors_and_edges_are_those_of_a_body(name: str) -> None:
    skeleton = CONVERSIONS[name].skeleton
    n = skeleton.n_joints
    assert n == SIZES[name]
    assert len(set(skeleton.joint_names)) == n
    mirror = np.array(skeleton.mirror)
    assert (mirror[mirror] == np.arange(n)).all()
    # Every sided joint has its other side, and the edges are symmetric.
    sided = [j for j in skeleton.joint_names if j[:1] in "RL" or "left" in j or "right" in j]
    assert (
        all(skeleton.mirror[skeleton.index(j)] != skeleton.index(j) for j in sided)
        or name == "lsp14"
    )
    edges = {frozenset(edge) for edge in skeleton.edges}
    assert len(edges) == len(skeleton.edges)
    assert {frozenset((mirror[a], mirror[b])) for a, b in skeleton.edges} == edges


@pytest.mark.parametrize("name", NAMES)
def test_all_options_are_affine_combinations(name: str) -> None:
    conversion = CONVERSIONS[name]
    for options in conversion.options.values():
        for option in options:
            assert sum(option.weights.values()) == pytest.approx(1)
    matrix = conversion.from_lsp14
    known = ~np.isnan(matrix).any(axis=1)
    np.testing.assert_allclose(matrix[known].sum(axis=1), 1)
    assert (matrix[known] >= 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_conversion_commutes_with_affine_maps_and_mirroring(
    name: str, rng: np.random.Generator
) -> None:
    conversion = CONVERSIONS[name]
    n = conversion.skeleton.n_joints
    points, confidence = rng.normal(size=(5, n, 3)), rng.uniform(0.1, 1, (5, n))
    linear, shift = affine_map(rng)
    got, sure = conversion.to_lsp14(points, confidence)
    moved, _ = conversion.to_lsp14(points @ linear.T + shift, confidence)
    np.testing.assert_allclose(moved, got @ linear.T + shift, atol=1e-12)
    mirror = list(conversion.skeleton.mirror)
    flipped, flipped_sure = conversion.to_lsp14(points[:, mirror], confidence[:, mirror])
    ours = list(LSP14.mirror)
    np.testing.assert_allclose(flipped, got[:, ours], atol=1e-12)
    np.testing.assert_allclose(flipped_sure, sure[:, ours])


@pytest.mark.parametrize("name", NAMES)
def test_the_way_there_and_back_keeps_what_both_have(name: str, rng: np.random.Generator) -> None:
    conversion = CONVERSIONS[name]
    pose = rng.normal(size=(1, 14, 3))
    foreign = np.einsum("nj,pjd->pnd", conversion.from_lsp14, pose)
    known = np.isfinite(foreign).all(-1)
    back, sure = conversion.to_lsp14(np.nan_to_num(foreign), known.astype(float))
    same = sure[0] == 1
    assert same[2:].all()
    np.testing.assert_allclose(back[0, same], pose[0, same], atol=1e-12)


def test_limbs_are_taken_over_exactly_and_never_crossed(rng: np.random.Generator) -> None:
    for name in NAMES:
        conversion = CONVERSIONS[name]
        points = rng.normal(size=(1, conversion.skeleton.n_joints, 2))
        got, _ = conversion.to_lsp14(points, np.ones(points.shape[:2]))
        for joint in LSP14.joint_names[2:]:
            (option,) = conversion.options[joint]
            (source,) = option.weights
            side = "right" if joint.startswith("r_") else "left"
            assert source.startswith((side, side[0].upper(), joint[:2]))
            column = conversion.skeleton.index(source)
            np.testing.assert_array_equal(got[0, LSP14.index(joint)], points[0, column])


@pytest.mark.parametrize("name", ["coco17", "openpose18", "mediapipe33"])
def test_a_face_puts_neck_and_head_top_in_their_places(name: str) -> None:
    conversion = CONVERSIONS[name]
    points = np.zeros((1, conversion.skeleton.n_joints, 2))
    confidence = np.zeros(points.shape[:2])
    names = [joint.lower().replace("_", "") for joint in conversion.skeleton.joint_names]

    def put(long: str, short: str, x: float, y: float, sure: float = 1.0) -> None:
        column = names.index(long if long in names else short)
        points[0, column] = x, y
        confidence[0, column] = sure

    put("leftshoulder", "lshoulder", 20, 0, 0.9)
    put("rightshoulder", "rshoulder", -20, 0)
    got, sure = conversion.to_lsp14(points, confidence)
    np.testing.assert_allclose(got[0, NECK], 0)  # a makeshift: the shoulders' midpoint
    assert sure[0, NECK] == pytest.approx(GUESS * 0.9)
    assert sure[0, HEAD_TOP] == 0

    put("nose", "nose", 0, -40, 0.8)
    _, sure = conversion.to_lsp14(points, confidence)
    assert sure[0, HEAD_TOP] == pytest.approx(GUESS * 0.8)

    put("leftear", "lear", 7, -42)
    put("rightear", "rear", -7, -42)
    got, sure = conversion.to_lsp14(points, confidence)
    np.testing.assert_allclose(got[0, NECK], [0, -42 * NECK_TO_EARS])
    assert got[0, HEAD_TOP, 0] == pytest.approx(0)
    assert -72 < got[0, HEAD_TOP, 1] < -58  # above the ears, by a good half of the way up to them
    assert sure[0, [NECK, HEAD_TOP]] == pytest.approx([0.9, 0.8])


def face(name: str) -> tuple[Conversion, int, int]:
    """A skeleton's conversion, and the numbers of its left ear and nose."""
    conversion = CONVERSIONS[name]
    names = [joint.lower().replace("_", "") for joint in conversion.skeleton.joint_names]
    return conversion, names.index("leftear" if "leftear" in names else "lear"), names.index("nose")


def seen(conversion: Conversion, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One person's joints anywhere, all of them sure."""
    joints = conversion.skeleton.n_joints
    return rng.normal(size=(1, joints, 2)), np.ones((1, joints))


@pytest.mark.parametrize("name", ["coco17", "openpose18", "mediapipe33"])
def test_an_ear_that_is_hardly_believed_in_is_as_good_as_none(
    name: str, rng: np.random.Generator
) -> None:
    conversion, ear, _ = face(name)
    points, confidence = seen(conversion, rng)
    confidence[0, ear] = 0.1
    got, sure = conversion.to_lsp14(points, confidence)
    confidence[0, ear] = 0.0
    without, as_sure = conversion.to_lsp14(points, confidence)
    np.testing.assert_array_equal(got, without)
    np.testing.assert_array_equal(sure, as_sure)


@pytest.mark.parametrize("name", ["coco17", "openpose18", "mediapipe33"])
def test_a_nose_aside_of_the_only_ear_is_no_tilt_of_the_head(
    name: str, rng: np.random.Generator
) -> None:
    conversion, ear, nose = face(name)
    points, confidence = seen(conversion, rng)
    confidence[0, ear] = 0.0
    got, _ = conversion.to_lsp14(points, confidence)
    points[0, nose] += [30.0, 0.0]
    aside, _ = conversion.to_lsp14(points, confidence)
    np.testing.assert_array_equal(aside[0, HEAD_TOP], got[0, HEAD_TOP])


def test_human36m_needs_no_face_and_returns_root_and_spine(rng: np.random.Generator) -> None:
    conversion = CONVERSIONS["h36m17"]
    pose = rng.normal(size=(14, 3))
    joints = conversion.from_lsp14 @ pose
    assert np.isfinite(joints).all()
    at = dict(zip(conversion.skeleton.joint_names, joints, strict=True))
    np.testing.assert_allclose(at["root"], (at["right_hip"] + at["left_hip"]) / 2)
    np.testing.assert_allclose(at["spine"], (at["root"] + at["thorax"]) / 2)
    np.testing.assert_array_equal(at["head"], pose[HEAD_TOP])


def test_coco_has_joints_that_lsp14_cannot_give() -> None:
    conversion = CONVERSIONS["coco17"]
    unknown = np.isnan(conversion.from_lsp14).any(axis=1)
    names = np.array(conversion.skeleton.joint_names)
    assert set(names[unknown]) == {"nose", "left_eye", "right_eye", "left_ear", "right_ear"}
