"""The process that ``heic`` starts for a photo: HEIC on stdin, header, EXIF and pixels on stdout.

Run as a file, so that nothing of the service is imported. The header is one line of JSON: width,
height and channels of the primary image, and the length of the EXIF data that follows. Pixels come
last, upright BGR or BGRA rows without gaps; none when there are more than the limit given.
"""

from __future__ import annotations

import json
import resource
import sys

_OWN_BYTES = 512 << 20
_BYTES_PER_PIXEL = 24
_CPU_S = 25


def main() -> None:
    """Decode what stdin has; exit code 1, or a signal, when that is impossible."""
    max_pixels = int(sys.argv[1])
    memory = _OWN_BYTES + _BYTES_PER_PIXEL * max_pixels
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_S, _CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import pi_heif

    pi_heif.options.DECODE_THREADS = 1  # the service's workers are the parallelism
    pi_heif.options.THUMBNAILS = False
    pi_heif.options.DEPTH_IMAGES = False
    image = pi_heif.open_heif(sys.stdin.buffer.read(), bgr_mode=True, convert_hdr_to_8bit=True)
    width, height = image.size
    channels = len(image.mode)
    exif = bytes(image.info.get("exif") or b"")
    said = {"width": width, "height": height, "channels": channels, "exif": len(exif)}
    sys.stdout.buffer.write(json.dumps(said).encode() + b"\n" + exif)
    if width * height <= max_pixels:
        rows, stride = memoryview(image.data), image.stride
        for top in range(height):
            sys.stdout.buffer.write(rows[top * stride : top * stride + width * channels])
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
