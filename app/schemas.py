"""The JSON contract: what the service takes and answers, with examples.

Pixels are those of the upright photo, (0, 0) the centre of its top-left pixel. Millimetres are in
the camera frame, OpenCV axes: x right, y down, z forward. A number that is not calibrated is null.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from library_store.conversion import CONVERSIONS

Method = Literal["fusion", "paper"]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Box = tuple[float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Pose = tuple[Vector3 | None, ...]
"""Joints in the answer's order; null where its skeleton has a joint that lsp14 does not give."""
GivenSkeleton = Literal["lsp14", "coco17", "h36m17", "openpose18", "mediapipe33"]
AnswerSkeleton = Literal["lsp14", "coco17", "h36m17"]

MAX_LIFT_PEOPLE = 256
MAX_CANDIDATES = 50
MAX_COORDINATE_PX = 1e6
MAX_GIVEN_JOINTS = max(c.skeleton.n_joints for c in CONVERSIONS.values())

CoordinatePx = Annotated[
    float, Field(ge=-MAX_COORDINATE_PX, le=MAX_COORDINATE_PX, allow_inf_nan=False)
]
FocalLengthPx = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
SubjectHeightMm = Annotated[float, Field(ge=300, le=3000, allow_inf_nan=False)]


def _whole(value: object) -> object:
    """JSON's 640.0 is the integer 640; what is no whole number stays as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Candidates = Annotated[int, Field(ge=0, le=MAX_CANDIDATES), BeforeValidator(_whole)]
SidePx = Annotated[int, Field(ge=1, le=1_000_000), BeforeValidator(_whole)]


class Answer(BaseModel):
    """Base of what is answered."""

    model_config = ConfigDict(frozen=True)


class Given(BaseModel):
    """Base of what is taken: unknown fields are errors, so that a typo is not ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Model(Answer):
    """The pose network that read the photo."""

    name: str
    version: str
    sha256: str


class Network(Answer):
    """A network in service: what it is, and what runs it in which precision."""

    kind: Literal["pose", "people", "lift"]
    name: str
    version: str
    sha256: str
    provider: Literal["cpu", "cuda", "openvino"]
    precision: Literal["fp32", "bf16", "int8"]
    parameters: int
    gflop: float
    input_px: int | None = Field(description="longer side of what it sees; null: no picture")


class LibraryRef(Answer):
    """The exemplar library that was searched."""

    name: str
    version: str
    exemplars: int
    sha256: str


class Image(Answer):
    """The upright photo: its size, and the EXIF orientation that was applied to get there."""

    width_px: int
    height_px: int
    orientation_applied: int = Field(ge=1, le=8)


class Skeleton(Answer):
    """Order and connection of the joints of every pose; left and right are the person's own."""

    name: str
    joint_names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]


class Joint2D(Answer):
    """A joint in the photo.

    ``confidence`` is the calibrated probability that it is within 0.2 torso lengths of the truth
    (of joints given to /v1/lift, what was stated); ``sigma_px`` the radius that holds 68% of its
    errors.
    """

    name: str
    x_px: float
    y_px: float
    confidence: float | None
    sigma_px: float | None


class Joint3D(Answer):
    """A joint in the camera frame; ``sigma_mm`` is the radius holding 68% of its errors."""

    name: str
    x_mm: float
    y_mm: float
    z_mm: float
    sigma_mm: float | None


class MocapSource(Answer):
    """An exemplar that was captured: the clip and its frame, maybe mirrored.

    ``subject`` and ``action`` are empty where the clip does not say them.
    """

    kind: Literal["mocap"] = "mocap"
    clip: str
    frame: int
    mirrored: bool = False
    subject: str = ""
    action: str = ""


class SourcePart(Answer):
    """A part of a composed exemplar and the captured frame it was taken from."""

    part: Literal["legs", "upper_body"]
    clip: str
    frame: int
    mirrored: bool


class ComposedSource(Answer):
    """An exemplar put together from parts of captured ones: the composition and its number."""

    kind: Literal["composed"] = "composed"
    index: int
    parts: tuple[SourcePart, ...]


class SampledSource(Answer):
    """An exemplar drawn from a pose prior: the prior and the number of the draw."""

    kind: Literal["sampled"] = "sampled"
    prior: str
    index: int


Source = Annotated[MocapSource | ComposedSource | SampledSource, Field(discriminator="kind")]


class Exemplar(Answer):
    """The best single match.

    ``probability`` is eq. 4 over the shortlist, ``distance`` the descriptor's. ``joints_mm`` is
    its pose placed by the camera M*, ``warped_mm`` that pose warped onto the 2D joints (eq. 6);
    both in the camera frame.
    """

    id: str
    probability: float
    distance: float
    source: Source
    joints_mm: Pose
    warped_mm: Pose


class Candidate(Answer):
    """One of the shortlist, most probable first; ``joints_mm`` in the camera frame."""

    id: str
    probability: float
    reprojection_error_px: float
    joints_mm: Pose


class Camera(Answer):
    """M* (eq. 5) of the best exemplar: X_camera = scale * (rotation @ X_exemplar) + translation.

    ``scale`` is 1 unless the request gave ``subject_height_mm``. The exemplar's own frame is
    root-centred with Y up. For a mirrored photo the map contains the reflection: the determinant
    of ``rotation`` is then -1.
    """

    model: Literal["pinhole"] = "pinhole"
    focal_length_px: float
    principal_point_px: Vector2
    focal_source: Literal["request", "exif", "assumed"]
    rotation: Matrix3
    translation_mm: Vector3
    scale: float
    reprojection_error_px: float


class Person(Answer):
    """One person; the 3D fields are null when too little of them is seen, and a warning says so.

    ``joints_2d`` of a photo lists every joint of the skeleton, that of /v1/lift the joints given.
    Of an answer in another skeleton than lsp14, ``joints_2d`` and ``joints_3d`` leave out the
    joints that lsp14 does not determine (coco17: the face).
    ``box_px`` is x, y, width, height of the joints' extent; ``score`` is null when the client
    gave the box or the joints. ``root_mm`` is the midpoint of the hips.
    """

    box_px: Box
    score: float | None
    joints_2d: tuple[Joint2D, ...]
    exemplar: Exemplar | None
    candidates: tuple[Candidate, ...]
    camera: Camera | None
    joints_3d: tuple[Joint3D, ...] | None
    root_mm: Vector3 | None
    scale_source: Literal["library", "request"] | None
    warnings: tuple[str, ...]


class PosesAnswer(Answer):
    """Everything about everybody in one photo."""

    request_id: str
    method: Method
    model: Model
    library: LibraryRef
    image: Image
    skeleton: Skeleton
    people: tuple[Person, ...]
    timings_ms: dict[str, float]


class LiftAnswer(Answer):
    """3D of everybody whose 2D joints were given, in the order given."""

    request_id: str
    method: Method
    library: LibraryRef
    skeleton: Skeleton
    people: tuple[Person, ...]
    timings_ms: dict[str, float]


class GivenJoint(Given):
    """A 2D joint to lift; confidence 0 means that it is missing."""

    name: str
    x_px: CoordinatePx
    y_px: CoordinatePx
    confidence: float = Field(1.0, ge=0, le=1)


class GivenPerson(Given):
    """A person's 2D joints; those left out are missing."""

    joints_2d: tuple[GivenJoint, ...] = Field(max_length=MAX_GIVEN_JOINTS)

    @model_validator(mode="after")
    def _names_are_distinct(self) -> Self:
        names = [joint.name for joint in self.joints_2d]
        if len(set(names)) < len(names):
            raise ValueError("a joint is given twice")
        return self


class ImageSize(Given):
    """Size of the upright photo the joints are from."""

    width_px: SidePx
    height_px: SidePx


class LiftRequest(Given):
    """2D joints in, no photo; focal length and principal point default as for photos.

    ``skeleton`` names the joints given, ``answer_skeleton`` those of the answer.
    """

    image: ImageSize
    focal_length_px: FocalLengthPx | None = None
    principal_point_px: tuple[CoordinatePx, CoordinatePx] | None = None
    skeleton: GivenSkeleton = "lsp14"
    answer_skeleton: AnswerSkeleton = "lsp14"
    method: Method = "fusion"
    candidates: Candidates = 3
    subject_height_mm: SubjectHeightMm | None = None
    people: tuple[GivenPerson, ...] = Field(max_length=MAX_LIFT_PEOPLE)

    @field_validator("people")
    @classmethod
    def _joints_are_of_the_skeleton(
        cls, people: tuple[GivenPerson, ...], info: ValidationInfo
    ) -> tuple[GivenPerson, ...]:
        if (name := info.data.get("skeleton")) is None:  # wrong itself, and said so
            return people
        known = set(CONVERSIONS[name].skeleton.joint_names)
        for number, person in enumerate(people):
            given = {joint.name for joint in person.joints_2d}
            if unknown := sorted(given - known):
                raise ValueError(f"unknown joints of {name} in people.{number}: {unknown}")
        return people


class Licence(Answer):
    """Where some of the library's poses come from and what may be done with them."""

    source: str
    licence: str
    credit: str


class ExemplarAnswer(Answer):
    """One exemplar of the library: its pose in its own frame (root-centred, Y up, mm), its
    provenance, and the library camera it was projected with: X_camera = rotation @ X + translation.
    """  # noqa: D205

    id: str
    library: LibraryRef
    skeleton: Skeleton
    source: Source
    licences: tuple[Licence, ...]
    joints_mm: Pose
    rotation: Matrix3
    translation_mm: Vector3


class Limits(Answer):
    """What is accepted."""

    accepted_types: tuple[str, ...]
    max_body_bytes: int
    max_batch_body_bytes: int
    max_batch_images: int
    max_pixels: int
    max_lift_people: int
    upload_timeout_s: float
    deadline_ms: float


class InfoAnswer(Answer):
    """What is served: version, model, library, skeleton, limits."""

    name: str
    version: str
    model: Model
    networks: tuple[Network, ...]
    library: LibraryRef
    licences: tuple[Licence, ...]
    skeleton: Skeleton
    methods: tuple[Method, ...]
    limits: Limits


class Health(Answer):
    """Whether the process lives, or is ready."""

    status: Literal["ok"] = "ok"


class Problem(Answer):
    """An error (RFC 9457); ``type`` is stable, further members depend on it."""

    model_config = ConfigDict(frozen=True, extra="allow")

    type: str
    title: str
    status: int
    detail: str
    request_id: str


class BatchItem(Answer):
    """The answer to one image of a batch, or its problem; exactly one of them is set."""

    name: str
    answer: PosesAnswer | None
    problem: Problem | None


class BatchAnswer(Answer):
    """Answers in the order of the images."""

    request_id: str
    images: tuple[BatchItem, ...]
