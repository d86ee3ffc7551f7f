"""From the bytes of a photo to upright BGR pixels.

The header is read first by our own small parsers (``headers``), so that a photo is refused by
type, by completeness and by pixels before a decoder sees it; ``exif`` reads the orientation and
the focal length; ``decode`` decodes, at a reduced scale where that suffices, and turns upright;
``heic`` is what iPhones save, read when its extra is installed.
"""

from app.imaging.decode import Photo, decode_photo
from app.imaging.headers import KNOWN_TYPES, ImageHeader, accepted_types, read_header

__all__ = ["KNOWN_TYPES", "ImageHeader", "Photo", "accepted_types", "decode_photo", "read_header"]
