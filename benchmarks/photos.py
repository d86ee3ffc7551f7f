"""Photos of other kinds, made from the sample renders, for the other benchmarks' ``--photo``.

    python -m benchmarks.photos DIR

writes ``phone.jpg`` (12 megapixels, with a sensor's noise, 1.8 MB), ``phone-fine.jpg`` (the same of
higher quality, 3.1 MB; phones write 2 to 5) and ``five.jpg`` (640 x 480, five people side by side).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.service import DEFAULT_PHOTO

Image = npt.NDArray[np.uint8]

_PHONE_PX = (4032, 3024)
_NOISE = 4.0
_QUALITY, _FINE = 85, 92
_NARROW = (("000.jpg", 122), ("014.jpg", 176))
"""Renders and where the 256 pixels around their person begin."""


def main() -> None:
    """Write the photos into the directory named on the command line."""
    parser = argparse.ArgumentParser(description="Write photos for the benchmarks.")
    parser.add_argument("directory", type=Path)
    directory: Path = parser.parse_args().directory
    directory.mkdir(parents=True, exist_ok=True)
    phone = make_phone_photo()
    for name, image, quality in (
        ("phone.jpg", phone, _QUALITY),
        ("phone-fine.jpg", phone, _FINE),
        ("five.jpg", make_five(), _QUALITY),
    ):
        flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
        (directory / name).write_bytes(cv2.imencode(".jpg", image, flags)[1].tobytes())


def make_phone_photo() -> Image:
    """The default photo at 12 megapixels; the noise costs the decoder what a sensor's does."""
    image = cv2.resize(_read(DEFAULT_PHOTO), _PHONE_PX, interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(0).normal(0, _NOISE, (*image.shape[:2], 1))
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def make_five() -> Image:
    """Five people side by side in 640 x 480: two narrow ones of the renders in turn."""
    canvas = np.full((480, 640, 3), 127, np.uint8)
    for number in range(5):
        name, left = _NARROW[number % len(_NARROW)]
        column = _read(DEFAULT_PHOTO.parent / name)[:, left : left + 256]
        small = cv2.resize(column, (128, 240), interpolation=cv2.INTER_AREA)
        canvas[120:360, 128 * number : 128 * (number + 1)] = small
    return canvas


def _read(path: Path) -> Image:
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path} cannot be read")
    return np.asarray(image, np.uint8)


if __name__ == "__main__":
    main()
