import numpy as np

from app.lifting.proportions import PROPORTION_DIRECTIONS
from app.lifting.stature import stature_mm
from library_store.anatomy import measure_lengths
from library_store.library import Library


def test_directions_change_lengths_and_neither_angles_nor_stature(library: Library) -> None:
    pose = library.poses_mm(17)
    lengths = measure_lengths(pose)
    for direction in PROPORTION_DIRECTIONS @ pose:
        moved = pose + 1e-3 * direction
        assert abs(stature_mm(moved) / stature_mm(pose) - 1.0) < 2e-5
        for start, end in ((1, 0), (2, 3), (3, 4), (9, 10), (12, 13)):
            bones = [joints[end] - joints[start] for joints in (pose, moved)]
            cosine = bones[0] @ bones[1] / np.prod(np.linalg.norm(bones, axis=1))
            assert cosine > 1.0 - 1e-9
        np.testing.assert_allclose(moved[8] + moved[11], 0.0, atol=1e-3)
    moved_lengths = np.stack(
        [
            np.log(measure_lengths(pose + 1e-4 * direction) / lengths) / 1e-4
            for direction in PROPORTION_DIRECTIONS @ pose
        ]
    )
    # Seven independent directions of unit spread.
    np.testing.assert_allclose(moved_lengths @ moved_lengths.T, np.eye(7), atol=0.02)
