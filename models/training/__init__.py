"""Training of the pose and person networks (needs the ``train`` extra: torch, onnx)."""
