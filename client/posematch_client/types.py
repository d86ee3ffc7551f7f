"""The JSON of the posematch service as types. Generated from its OpenAPI document: do not edit.

Pixels are those of the upright photo, (0, 0) the centre of its top-left pixel. Millimetres are in
the camera frame: x right, y down, z forward.
"""

# ruff: noqa: D205
from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NotRequired, TypedDict


class BatchAnswer(TypedDict):
    """Answers in the order of the images."""

    images: list[BatchItem]
    request_id: str


class BatchItem(TypedDict):
    """The answer to one image of a batch, or its problem; exactly one of them is set."""

    answer: PosesAnswer | None
    name: str
    problem: Problem | None


class Camera(TypedDict):
    """M* (eq. 5) of the best exemplar: X_camera = scale * (rotation @ X_exemplar) + translation.

    ``scale`` is 1 unless the request gave ``subject_height_mm``. The exemplar's own frame is
    root-centred with Y up. For a mirrored photo the map contains the reflection: the determinant
    of ``rotation`` is then -1.
    """

    focal_length_px: float
    focal_source: Literal["request", "exif", "assumed"]
    model: Literal["pinhole"]
    principal_point_px: list[float]
    reprojection_error_px: float
    rotation: list[list[float]]
    scale: float
    translation_mm: list[float]


class Candidate(TypedDict):
    """One of the shortlist, most probable first; ``joints_mm`` in the camera frame."""

    id: str
    joints_mm: list[list[float] | None]
    probability: float
    reprojection_error_px: float


class ComposedSource(TypedDict):
    """An exemplar put together from parts of captured ones: the composition and its number."""

    index: int
    kind: Literal["composed"]
    parts: list[SourcePart]


class Exemplar(TypedDict):
    """The best single match.

    ``probability`` is eq. 4 over the shortlist, ``distance`` the descriptor's. ``joints_mm`` is
    its pose placed by the camera M*, ``warped_mm`` that pose warped onto the 2D joints (eq. 6);
    both in the camera frame.
    """

    distance: float
    id: str
    joints_mm: list[list[float] | None]
    probability: float
    source: MocapSource | ComposedSource | SampledSource
    warped_mm: list[list[float] | None]


class ExemplarAnswer(TypedDict):
    """One exemplar of the library: its pose in its own frame (root-centred, Y up, mm), its
    provenance, and the library camera it was projected with: X_camera = rotation @ X + translation.
    """

    id: str
    joints_mm: list[list[float] | None]
    library: LibraryRef
    licences: list[Licence]
    rotation: list[list[float]]
    skeleton: Skeleton
    source: MocapSource | ComposedSource | SampledSource
    translation_mm: list[float]


class GivenJoint(TypedDict):
    """A 2D joint to lift; confidence 0 means that it is missing."""

    confidence: NotRequired[float]
    name: str
    x_px: float
    y_px: float


class GivenPerson(TypedDict):
    """A person's 2D joints; those left out are missing."""

    joints_2d: Sequence[GivenJoint]


class Health(TypedDict):
    """Whether the process lives, or is ready."""

    status: Literal["ok"]


class Image(TypedDict):
    """The upright photo: its size, and the EXIF orientation that was applied to get there."""

    height_px: int
    orientation_applied: int
    width_px: int


class ImageSize(TypedDict):
    """Size of the upright photo the joints are from."""

    height_px: int
    width_px: int


class InfoAnswer(TypedDict):
    """What is served: version, model, library, skeleton, limits."""

    library: LibraryRef
    licences: list[Licence]
    limits: Limits
    methods: list[Literal["fusion", "paper"]]
    model: Model
    name: str
    networks: list[Network]
    skeleton: Skeleton
    version: str


class Joint2D(TypedDict):
    """A joint in the photo.

    ``confidence`` is the calibrated probability that it is within 0.2 torso lengths of the truth
    (of joints given to /v1/lift, what was stated); ``sigma_px`` the radius that holds 68% of its
    errors.
    """

    confidence: float | None
    name: str
    sigma_px: float | None
    x_px: float
    y_px: float


class Joint3D(TypedDict):
    """A joint in the camera frame; ``sigma_mm`` is the radius holding 68% of its errors."""

    name: str
    sigma_mm: float | None
    x_mm: float
    y_mm: float
    z_mm: float


class LibraryRef(TypedDict):
    """The exemplar library that was searched."""

    exemplars: int
    name: str
    sha256: str
    version: str


class Licence(TypedDict):
    """Where some of the library's poses come from and what may be done with them."""

    credit: str
    licence: str
    source: str


class LiftAnswer(TypedDict):
    """3D of everybody whose 2D joints were given, in the order given."""

    library: LibraryRef
    method: Literal["fusion", "paper"]
    people: list[Person]
    request_id: str
    skeleton: Skeleton
    timings_ms: dict[str, float]


class LiftRequest(TypedDict):
    """2D joints in, no photo; focal length and principal point default as for photos.

    ``skeleton`` names the joints given, ``answer_skeleton`` those of the answer.
    """

    answer_skeleton: NotRequired[Literal["lsp14", "coco17", "h36m17"]]
    candidates: NotRequired[int]
    focal_length_px: NotRequired[float | None]
    image: ImageSize
    method: NotRequired[Literal["fusion", "paper"]]
    people: Sequence[GivenPerson]
    principal_point_px: NotRequired[Sequence[float] | None]
    skeleton: NotRequired[Literal["lsp14", "coco17", "h36m17", "openpose18", "mediapipe33"]]
    subject_height_mm: NotRequired[float | None]


class Limits(TypedDict):
    """What is accepted."""

    accepted_types: list[str]
    deadline_ms: float
    max_batch_body_bytes: int
    max_batch_images: int
    max_body_bytes: int
    max_lift_people: int
    max_pixels: int
    upload_timeout_s: float


class MocapSource(TypedDict):
    """An exemplar that was captured: the clip and its frame, maybe mirrored.

    ``subject`` and ``action`` are empty where the clip does not say them.
    """

    action: str
    clip: str
    frame: int
    kind: Literal["mocap"]
    mirrored: bool
    subject: str


class Model(TypedDict):
    """The pose network that read the photo."""

    name: str
    sha256: str
    version: str


class Network(TypedDict):
    """A network in service: what it is, and what runs it in which precision."""

    gflop: float
    input_px: int | None
    kind: Literal["pose", "people", "lift"]
    name: str
    parameters: int
    precision: Literal["fp32", "bf16", "int8"]
    provider: Literal["cpu", "cuda", "openvino"]
    sha256: str
    version: str


class Person(TypedDict):
    """One person; the 3D fields are null when too little of them is seen, and a warning says so.

    ``joints_2d`` of a photo lists every joint of the skeleton, that of /v1/lift the joints given.
    Of an answer in another skeleton than lsp14, ``joints_2d`` and ``joints_3d`` leave out the
    joints that lsp14 does not determine (coco17: the face).
    ``box_px`` is x, y, width, height of the joints' extent; ``score`` is null when the client
    gave the box or the joints. ``root_mm`` is the midpoint of the hips.
    """

    box_px: list[float]
    camera: Camera | None
    candidates: list[Candidate]
    exemplar: Exemplar | None
    joints_2d: list[Joint2D]
    joints_3d: list[Joint3D] | None
    root_mm: list[float] | None
    scale_source: Literal["library", "request"] | None
    score: float | None
    warnings: list[str]


class PosesAnswer(TypedDict):
    """Everything about everybody in one photo."""

    image: Image
    library: LibraryRef
    method: Literal["fusion", "paper"]
    model: Model
    people: list[Person]
    request_id: str
    skeleton: Skeleton
    timings_ms: dict[str, float]


class Problem(TypedDict):
    """An error (RFC 9457); ``type`` is stable, further members depend on it."""

    detail: str
    request_id: str
    status: int
    title: str
    type: str


class SampledSource(TypedDict):
    """An exemplar drawn from a pose prior: the prior and the number of the draw."""

    index: int
    kind: Literal["sampled"]
    prior: str


class Skeleton(TypedDict):
    """Order and connection of the joints of every pose; left and right are the person's own."""

    edges: list[list[int]]
    joint_names: list[str]
    name: str


class SourcePart(TypedDict):
    """A part of a composed exemplar and the captured frame it was taken from."""

    clip: str
    frame: int
    mirrored: bool
    part: Literal["legs", "upper_body"]


class PoseParameters(TypedDict):
    """What to do with a photo."""

    # Most people to answer: the surest, most certain first.
    max_people: NotRequired[int]
    # How many of the shortlist (30; 10 with `method=paper`) to return at most; never changes the
    # answer.
    candidates: NotRequired[int]
    # `paper` is the method of Chen & Ramanan (2017) to the letter.
    method: NotRequired[Literal["fusion", "paper"]]
    # In whose joints to answer. Joints that lsp14 does not give are left out of lists by name and
    # null in `joints_mm`.
    skeleton: NotRequired[Literal["lsp14", "coco17", "h36m17"]]
    # `x,y,w,h`: the extent of the one person to look at; skips detection.
    box_px: NotRequired[str | Sequence[float]]
    # Focal length in pixels of the photo as sent. Excludes fov_deg.
    focal_length_px: NotRequired[float]
    # Field of view over the longer side. Excludes focal_length_px.
    fov_deg: NotRequired[float]
    # How tall the person is; fixes the scale, else the library's people do.
    subject_height_mm: NotRequired[float]
    # The photo is a mirror image (a selfie): left and right are told apart on the flipped photo;
    # the answer is in the pixels given.
    mirrored: NotRequired[bool]
