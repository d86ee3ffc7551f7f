"""Rendered people with exact labels: body, pose, look and pixels, in plain numpy and OpenCV."""
