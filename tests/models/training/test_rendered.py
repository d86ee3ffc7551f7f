"""Rendered people: the labels are the projections, and the pictures show what the labels say."""

from pathlib import Path

import numpy as np
import pytest

from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)
from models.training.dataset import load
from models.training.rendered import make_entry, write_tar
from models.training.rendering.backdrop import Backgrounds
from models.training.rendering.body import BODY, BodyModel, RestBody, Shape
from models.training.rendering.look import BodyMap, Look
from models.training.rendering.pose import Poser, TrunkStats, mirrored, turn
from models.training.rendering.poses import PoseSource, aligned_distance_mm, with_upper_body
from models.training.rendering.raster import normals, rasterise
from models.training.rendering.scene import Studio
from tests.models.training.box_body import write_box_body

STANDING = np.array(
    [
        [0, 1750, 60],
        [0, 1500, 0],
        [-180, 1450, 0],
        [-300, 1200, -30],
        [-330, 950, 60],
        [180, 1450, 0],
        [300, 1200, -30],
        [330, 950, 60],
        [-95, 920, 0],
        [-105, 500, 20],
        [-110, 90, -30],
        [95, 920, 0],
        [105, 500, 20],
        [110, 90, -30],
    ],
    np.float32,
)


def other_poses(count: int) -> np.ndarray:
    """The same person with limbs turned about their parents."""
    rng = np.random.default_rng(3)
    limbs = (
        (R_SHOULDER, (R_ELBOW, R_WRIST)),
        (L_SHOULDER, (6, L_WRIST)),
        (R_HIP, (R_KNEE, R_ANKLE)),
        (L_HIP, (L_KNEE, L_ANKLE)),
    )
    poses = np.repeat(STANDING[None], count, 0)
    for pose in poses:
        for pivot, joints in limbs:
            for about, moved in ((pivot, joints), (joints[0], joints[1:])):
                rotation = turn(np.array([1.0, 0.3, 0.5]), -float(rng.uniform(0, 1.3)))
                rows = list(moved)
                pose[rows] = (pose[rows] - pose[about]) @ rotation.T + pose[about]
    return poses


class MeansOnly(np.random.Generator):
    """Draws nothing but means, which are the same on both sides."""

    def normal(self, loc=0.0, *_):  # type: ignore[no-untyped-def]
        return loc

    def uniform(self, low=0.0, high=1.0, *_):  # type: ignore[no-untyped-def]
        return (low + high) / 2


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    return BodyModel(write_box_body(tmp_path_factory.mktemp("mpfb2")))


@pytest.fixture(scope="module")
def rest(model: BodyModel) -> RestBody:
    return model.rest(Shape(0.0, 25.0, 0.5, 0.5, 0.5, 0.5, (0.3, 0.3, 0.4)))


@pytest.fixture(scope="module")
def poser(model: BodyModel) -> Poser:
    return Poser(model, TrunkStats.of(STANDING[None]))


@pytest.fixture(scope="module")
def studio(model: BodyModel, poser: Poser) -> Studio:
    photo = np.random.default_rng(0).integers(0, 256, (80, 100, 3)).astype(np.uint8)
    people = np.array([[0, 0, 20, 80]], np.float32)
    source = PoseSource(other_poses(30), None, clusters=5)
    return Studio(model, poser, source, Backgrounds([photo], [people]), cast=2)


def test_the_nearer_face_is_seen_filled_and_only_from_its_front() -> None:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    vertices = np.concatenate(
        [np.c_[square, np.full(4, 2.0)], np.c_[square / 2, np.full(4, 1.0)]]
    ).astype(np.float32)
    xy = np.concatenate([square * 20 + 31.5, square * 10 + 31.5]).astype(np.float32)
    facing = np.array([[3, 2, 1, 0], [7, 6, 5, 4]])
    one_sided = np.zeros(2, bool)
    seen = rasterise(vertices, xy, facing, one_sided, 64)
    assert len(seen.index) == 40 * 40
    rows, columns = np.divmod(seen.index, 64)
    inner = (np.abs(rows - 31.5) < 10) & (np.abs(columns - 31.5) < 10)
    np.testing.assert_array_equal(seen.quad, np.where(inner, 1, 0))
    np.testing.assert_allclose(seen.depth[32, 32], 1)
    np.testing.assert_allclose(seen.depth[15, 15], 2)
    np.testing.assert_allclose(seen.corner_weights.sum(1), 1, atol=1e-6)
    assert len(rasterise(vertices, xy, facing[:, ::-1], one_sided, 64).index) == 0
    assert len(rasterise(vertices, xy, facing[:, ::-1], ~one_sided, 64).index) == 40 * 40


def test_normals_of_the_body_point_outwards(model: BodyModel) -> None:
    quads = model.quads[model.kind == BODY]
    normal = normals(model.base, quads)
    for box in quads.reshape(-1, 6 * 4):
        outwards = model.base[box] - model.base[box].mean(0)
        assert (np.einsum("vi,vi->v", normal[box], outwards) > 0).all()


def test_a_pose_sets_the_limbs_directions_and_keeps_their_lengths(
    poser: Poser, rest: RestBody
) -> None:
    before = poser.joints_of(rest.vertices, rest.bone_heads)
    limbs = [(a, b) for a, b in LSP14.edges if NECK not in (a, b)]
    for k, target in enumerate(other_poses(8)):
        posed = poser.pose(rest, target / 1000, np.random.default_rng(k)).joints
        for a, b in limbs:
            bone, wanted = posed[b] - posed[a], target[b] - target[a]
            np.testing.assert_allclose(
                np.linalg.norm(bone), np.linalg.norm(before[b] - before[a]), rtol=1e-3
            )
            cos = bone @ wanted / np.linalg.norm(bone) / np.linalg.norm(wanted)
            assert cos > 0.999, (LSP14.joint_names[a], LSP14.joint_names[b])


def test_a_mirrored_pose_gives_the_mirrored_body(model: BodyModel, rest: RestBody) -> None:
    rng = MeansOnly(np.random.PCG64(0))
    neutral = Poser(model, TrunkStats.of(np.stack([STANDING, mirrored(STANDING)])))
    for target in other_poses(4):
        one = neutral.pose(rest, target, rng).joints
        two = neutral.pose(rest, mirrored(target), rng).joints
        one = mirrored(one)[NECK:]  # the boxes' head top is a corner
        np.testing.assert_allclose(one - one[0], two[NECK:] - two[NECK], atol=1e-4)


def test_labels_lie_on_the_person_and_fill_the_crop(studio: Studio) -> None:
    for seed in range(12):
        crop = studio.crop(np.random.default_rng(seed), 96)
        assert crop.image.shape == (96, 96, 3)
        extent = (crop.joints_px.max(0) - crop.joints_px.min(0)).max()
        assert extent == pytest.approx(96 / 1.6, abs=0.5)
        at = np.rint(crop.joints_px).astype(int)
        limbs = [j for j in range(14) if crop.visible[j] and j not in (HEAD_TOP, NECK)]
        assert all(crop.mask[at[j, 1], at[j, 0]] > 0 for j in limbs)
        outside = crop.mask.copy()
        low, high = at.min(0) - 20, at.max(0) + 20
        outside[max(low[1], 0) : high[1], max(low[0], 0) : high[0]] = 0
        assert outside.sum() == 0


def test_the_camera_sees_the_joints_where_the_labels_are(studio: Studio) -> None:
    for seed in range(3):
        record = make_entry(studio, 6, seed).record
        joints, focal = np.array(record["joints_mm"]), record["focal_length_px"]
        assert 500 < np.ptp(joints, axis=0).max() < 2500, "millimetres"
        seen = focal * joints[:, :2] / joints[:, 2:] + record["principal_point_px"]
        np.testing.assert_allclose(seen, record["joints_px"], atol=0.03)


def test_a_crop_is_its_seed_s_and_number_s_and_comes_back_from_the_tar(
    studio: Studio, tmp_path: Path
) -> None:
    entries = [make_entry(studio, 5, number) for number in range(3)]
    again = make_entry(studio, 5, 1)
    assert (again.record, again.jpeg) == (entries[1].record, entries[1].jpeg)
    write_tar(tmp_path / "rendered.tar", entries, 5)
    crops = load(tmp_path / "rendered.tar")
    assert [c.name for c in crops] == ["r00000.jpg", "r00001.jpg", "r00002.jpg"]
    for crop, entry in zip(crops, entries, strict=True):
        np.testing.assert_allclose(crop.joints_px, entry.record["joints_px"], atol=1e-4)
        np.testing.assert_array_equal(crop.visible, entry.record["visible"])
        assert crop.weight.all()
        assert not crop.wild


def test_the_face_is_in_front_and_hair_behind(model: BodyModel) -> None:
    body = BodyMap(model)
    rng = np.random.default_rng(0)
    photo = np.zeros((8, 8, 3), np.uint8)
    head = np.zeros((2, 8), np.float32)
    head[:, 0], head[:, 1], head[:, 6] = -1, 1.5, 1
    head[:, 2:5] = body.eyes + np.array([[0.04, -0.025, 0.01], [0, -0.025, -0.2]])
    head[:, 5] = 1, -1
    kinds = np.full(2, BODY, np.int8)
    for _ in range(50):
        look = Look.draw(rng, False, photo)
        front, back = look.albedo(body, head, kinds)
        if look.hair_depth_m > 0 and not look.hat:
            np.testing.assert_array_equal(back, look.hair)
        if look.beard == 0:
            np.testing.assert_array_equal(front, look.skin)


def test_poses_near_the_test_poses_are_never_drawn() -> None:
    poses = other_poses(40)
    tests = poses[:4]
    source = PoseSource(poses, tests, clusters=5)
    near = aligned_distance_mm(source.poses, np.concatenate([tests, mirrored(tests[0])[None]]))
    assert 0 < len(source.poses) <= 36
    assert near.min() >= 60
    rng = np.random.default_rng(0)
    drawn = np.stack([source.draw(rng) for _ in range(60)])
    assert aligned_distance_mm(drawn, tests).min() >= 59.9


def test_aligned_distance_forgets_place_turn_and_size_and_nothing_else() -> None:
    pose = other_poses(1)
    moved = (0.7 * pose @ turn(np.array([1.0, 2, 3]), 1.1).T + 500).astype(np.float32)
    assert aligned_distance_mm(moved, pose).max() < 0.01
    assert aligned_distance_mm(mirrored(pose[0])[None], pose).min() > 20


def test_borrowed_arms_join_at_the_pelvis_and_leave_the_legs_alone() -> None:
    legs, upper = other_poses(2)
    joined = with_upper_body(legs, upper + 100)
    np.testing.assert_array_equal(joined[R_HIP:], legs[R_HIP:])
    hips = (joined[R_HIP] + joined[L_HIP]) / 2
    wanted = np.linalg.norm(upper[NECK] - (upper[R_HIP] + upper[L_HIP]) / 2)
    np.testing.assert_allclose(np.linalg.norm(joined[NECK] - hips), wanted, rtol=1e-4)
