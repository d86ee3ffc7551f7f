"""p(x | I): from a photo to people's boxes and 2D joints.

Networks run by onnxruntime, each with a JSON model card beside its weights: a person detector on
the whole photo, a Convolutional Pose Machine on each person's crop, and a lifter on their joints.
"""

import os

# onnxruntime reports its use to its makers, and keeps a database of what it has not yet sent,
# unless told otherwise before it is first imported. This service tells nobody about its users.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

from models.card import ModelCard
from models.errors import ModelError
from models.heatmaps import Joints2D
from models.person_detector import PersonBox, PersonDetector
from models.pose_estimator import PoseEstimator
from models.pose_lifter import PoseLifter
from models.providers import ProviderChoice, Runtime

__all__ = [
    "Joints2D",
    "ModelCard",
    "ModelError",
    "PersonBox",
    "PersonDetector",
    "PoseEstimator",
    "PoseLifter",
    "ProviderChoice",
    "Runtime",
]
