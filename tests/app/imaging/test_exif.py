"""What EXIF says of the lens, and EXIF that is damaged."""

from __future__ import annotations

import numpy as np
import pytest

from app.imaging.exif import read_exif
from tests.app.imaging.image_files import tiff


def test_exif_focal_length_holds_for_the_whole_sensor_only() -> None:
    stated = read_exif(tiff(1, focal_35mm=26, size=(4032, 3024)))
    focal = stated.focal_length_px(4032, 3024)
    assert focal is not None
    assert focal == pytest.approx(26 * 5040 / 43.2666, rel=1e-4)
    assert stated.focal_length_px(1008, 756) == pytest.approx(focal / 4), "scaled"
    assert stated.focal_length_px(3024, 4032) == pytest.approx(focal), "turned"
    assert stated.focal_length_px(3024, 3024) is None, "cropped"
    assert read_exif(tiff(1, focal_35mm=26)).focal_length_px(4032, 3024) is None
    assert read_exif(tiff(1, focal_35mm=0, size=(40, 30))).focal_length_px(40, 30) is None


def test_broken_exif_is_no_exif() -> None:
    whole = tiff(6, 26, (40, 30))
    for end in range(len(whole)):
        read_exif(whole[:end])
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] = rng.integers(256)
        exif = read_exif(bytes(damaged))
        assert 1 <= exif.orientation <= 8
    assert read_exif(tiff(9)).orientation == 1
