"""The service: HTTP in, JSON out, and the lifting pipeline behind it."""

import os

MAX_DECODABLE_PIXELS = 1 << 28
"""No image is ever decoded beyond this; ``Settings.max_pixels`` is the limit clients meet."""

# OpenCV and numpy's BLAS read these once, when they are first imported: so here, before any module
# of the service can import them. The pixels are a second line behind our own header check. The
# threads: requests run side by side, a core each, and a library's own would get in their way.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_DECODABLE_PIXELS))
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
