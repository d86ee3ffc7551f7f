"""People whom the photo's edge cuts off: a box of what is seen, and how large the person would be.

Of a portrait the box holds head, shoulders and arms, twice as large as those of whole people. The
pose network has learned from such crops (``models/training/shortened.py``), and still reads them
better at the scale that it knows best. The less it believes, the more of the person is missing, and
the more the box must grow beyond the edge. Where joints out there may be is then guessed as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.heatmaps import Floats
from models.person_detector import PersonBox

NEAR_EDGE = 0.25
"""Of the box's longer side: so far from the photo's edge a box may end that is cut off there. The
last joint to be seen lies well within, a hip of somebody cut off at the thighs."""
GROWTHS = ((0.12, 2.2), (0.26, 1.8), (0.36, 1.4))
"""What the mean belief in all joints (``models.looks.belief``) lies under, and how much longer the
whole person is: cut off at the waist, at the hips or thighs, at the knees (docs/experiments.md)."""
PLAINLY = 1.2
"""How many times as much must be believed of the whole person: of who ends near the edge, but is
not cut off, the larger view is believed in a little more now and then, and read worse."""


def beyond_edge(positions_px: Floats, width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Which joints (J, 2) px lie outside a photo of that size, (J,)."""
    size = np.array([width_px, height_px])
    outside: NDArray[np.bool_] = np.any((positions_px < -0.5) | (positions_px > size - 0.5), axis=1)
    return outside


def whole(box: PersonBox, width_px: int, height_px: int, belief: float) -> PersonBox | None:
    """The box as the whole person would have it, if the photo's edge seems to cut them off.

    It grows downwards, where photos end most often; else upwards; else to the one side that it
    lies at, as of portraits that lie on their side.

    Args:
        box: what is seen of the person, pixels of the photo.
        width_px: of the photo.
        height_px: of the photo.
        belief: how far the network believed in the joints it found in ``box``, 0 to 1.

    Returns:
        The larger box, or None for who is seen clearly, or ends within the photo.

    """
    growth = next((longer for least, longer in GROWTHS if belief < least), None)
    if growth is None:
        return None
    near = NEAR_EDGE * max(box.width_px, box.height_px)
    left, top = box.x_px < near, box.y_px < near
    right = box.x_px + box.width_px > width_px - near
    bottom = box.y_px + box.height_px > height_px - near
    x, y, width, height = box.x_px, box.y_px, box.width_px, box.height_px
    if bottom or top:
        height *= growth
        y = y if bottom else y + box.height_px - height
    elif left != right:
        width *= growth
        x = x if right else x + box.width_px - width
    else:
        return None
    return PersonBox(x, y, width, height, box.score)
