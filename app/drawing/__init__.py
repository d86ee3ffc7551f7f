"""Pictures of results: the joints over the photo, and the 3D from new viewpoints, as PNG or SVG.

``views`` lays a picture out as strokes, discs and words (``picture``); ``raster`` and ``svg`` make
the files. Right limbs are orange, left limbs blue (the person's own right and left), the middle
grey; the best exemplar, un-warped, stands behind in light grey; the photo's camera is drawn as
the pyramid of what it sees.
"""

from app.drawing.files import PICTURE_TYPES, encode_picture
from app.drawing.picture import Picture
from app.drawing.raster import to_pixels
from app.drawing.svg import to_svg
from app.drawing.views import NOVEL_VIEWS, Viewpoint, draw_novel_view, draw_overlay, draw_result

__all__ = [
    "NOVEL_VIEWS",
    "PICTURE_TYPES",
    "Picture",
    "Viewpoint",
    "draw_novel_view",
    "draw_overlay",
    "draw_result",
    "encode_picture",
    "to_pixels",
    "to_svg",
]
