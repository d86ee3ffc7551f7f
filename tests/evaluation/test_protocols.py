from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.errors import PoseMatchError
from evaluation.protocols import load_lifting_set

WHOLE: dict[str, Any] = {
    "joints_3d_mm": np.ones((5, 14, 3), np.float32),
    "focal_length_px": np.float64(1150.0),
    "joints_2d_px_noise10": np.ones((5, 14, 2), np.float32),
    "joints_2d_px_noise0": np.zeros((5, 14, 2), np.float32),
}


def test_a_set_is_read_with_its_levels_of_noise(tmp_path: Path) -> None:
    path = tmp_path / "people.npz"
    np.savez(path, **WHOLE)
    people = load_lifting_set(path)
    assert (people.name, list(people.joints_2d_px)) == ("people", [0, 10])
    assert people.joints_2d_px[10].mean() == 1.0
    assert people.intrinsics.focal_length_px == 1150.0
    assert len(people.half(1).joints_3d_mm) == 2


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"joints_3d_mm": np.ones((5, 17, 3))}, r"\(5, 17, 3\); wanted is \(N, 14, 3\)"),
        ({"joints_2d_px_noise10": np.ones((4, 14, 2))}, r"noise10 is \(4, 14, 2\)"),
        ({"joints_2d_px_noise0": np.full((5, 14, 2), np.nan)}, "5 of 5 people, the first number 0"),
        ({"focal_length_px": 0.0}, "focal_length_px is 0"),
    ],
)
def test_what_no_error_can_be_measured_of_is_named(
    tmp_path: Path, changed: dict[str, Any], said: str
) -> None:
    path = tmp_path / "people.npz"
    np.savez(path, **(WHOLE | changed))
    with pytest.raises(PoseMatchError, match=said):
        load_lifting_set(path)


@pytest.mark.parametrize("missing", [*WHOLE, "zip"])
def test_other_files_are_named(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "people.npz"
    kept = {name: array for name, array in WHOLE.items() if name[:9] != missing[:9]}
    np.savez(path, **kept)
    if missing == "zip":
        path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(PoseMatchError, match=r"people\.npz is no set of people to lift"):
        load_lifting_set(path)
