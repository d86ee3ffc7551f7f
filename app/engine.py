"""Everything a request needs, loaded once: network, detector, library, lifter, pipeline."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from app.errors import LibraryUnavailableError, StartupError
from app.lifting.lifter import Lifter, LiftingSettings
from app.pipeline import PhotoQuery, Pipeline
from app.settings import LIFTER_OFF, Settings
from library_store.build import ensure_default_library
from library_store.errors import LibraryError
from library_store.library import Library
from library_store.library import load as load_library
from library_store.milvus import MilvusSettings
from models import ModelCard, ModelError, PersonDetector, PoseEstimator, PoseLifter
from models.choice import choose
from models.session import runtimes

Progress = Callable[[str, float], None]

MAX_PEOPLE = 10
"""Most people of one photo; their crops are one batch."""
_WARM_UP_RUNS = 3


@dataclass(frozen=True)
class Engine:
    """What is served; ``photo_s`` is about how long a small photo of one person takes.

    ``lifter`` is the network that lifts beside the library, None if the settings want none.
    """

    library: Library
    card: ModelCard
    detector: PersonDetector
    estimator: PoseEstimator
    lifter: PoseLifter | None
    pipeline: Pipeline
    photo_s: float

    @property
    def networks(self) -> tuple[PoseEstimator | PersonDetector | PoseLifter, ...]:
        """All networks in service."""
        served = (self.estimator, self.detector)
        return served if self.lifter is None else (*served, *self.lifter.networks)


def locate_library(settings: Settings, progress: Progress | None = None) -> Path:
    """Directory of the library to serve, built first when it is the default one and missing.

    Raises ``StartupError``.
    """
    if settings.library_dir is not None:
        return settings.library_dir
    try:
        return ensure_default_library(settings.cache_dir, progress)
    except LibraryError as error:
        raise StartupError(str(error)) from error
    except OSError as error:
        raise StartupError(
            f"the default library cannot be built in {settings.cache_dir}: {error.strerror}; "
            "make that directory writable or set POSEMATCH_CACHE_DIR to another"
        ) from error


def chosen_networks(settings: Settings) -> tuple[str, str]:
    """Names of the pose network's card and of the person network's. Raises ``ModelError``."""
    where, provider = settings.weights_dir, settings.provider
    pose = settings.model
    if pose == "auto":
        pose = choose(where, "pose", provider=provider, budget_ms=settings.model_budget_ms)
    return pose, choose(where, "people", provider=provider)


def load_networks(settings: Settings) -> tuple[PoseEstimator, PersonDetector]:
    """The chosen networks, on the providers they were chosen for. Raises ``ModelError``.

    Where an installed provider cannot be started, another runs the networks: what is best there is
    chosen anew.
    """
    pose, people = chosen_networks(settings)
    where, provider, side_by_side = settings.weights_dir, settings.provider, settings.workers
    estimator = PoseEstimator(pose, weights_dir=where, provider=provider, concurrency=side_by_side)
    detector = PersonDetector(
        people, weights_dir=where, provider=provider, concurrency=side_by_side
    )
    for network in (estimator, detector):
        used = network.runtime
        if used != runtimes(network.card, provider)[0]:
            return load_networks(settings.model_copy(update={"provider": used.provider}))
    return estimator, detector


def load_lifter(settings: Settings) -> PoseLifter | None:
    """The lifting network of the settings, None for off. Raises ``ModelError``."""
    if settings.lifter == LIFTER_OFF:
        return None
    try:
        return PoseLifter(settings.lifter, weights_dir=settings.weights_dir)
    except ModelError as error:
        raise ModelError(f"{error} (POSEMATCH_LIFTER={LIFTER_OFF} serves without it)") from error


def load_engine(settings: Settings) -> Engine:
    """Load and warm up; blocking, a second or so.

    Raises ``StartupError`` naming the file that is missing or corrupt and how to mend it.
    """
    cv2.setNumThreads(1)  # the workers are the parallelism
    try:
        estimator, detector = load_networks(settings)
        lifter = load_lifter(settings)
        estimator.warm_up(MAX_PEOPLE)
        detector.warm_up()
    except ModelError as error:
        raise StartupError(str(error)) from error
    library = _open_library(locate_library(settings), settings)
    pipeline = _assemble(detector, estimator, lifter, library, settings)
    photo_s = _warm_up(pipeline, settings.max_pixels)
    return Engine(library, estimator.card, detector, estimator, lifter, pipeline, photo_s)


def reload_engine(engine: Engine, settings: Settings) -> Engine | None:
    """The engine with the library as it now lies on the disk, verified and warm; blocking.

    None when those are the files that it has open, unwritten since. The networks are shared with
    ``engine``, which stays in service meanwhile. Raises ``StartupError`` when the library cannot be
    used.
    """
    directory = locate_library(settings)
    if engine.library.is_in(directory):
        return None
    library = _open_library(directory, settings)
    pipeline = _assemble(engine.detector, engine.estimator, engine.lifter, library, settings)
    try:
        _warm_up(pipeline, settings.max_pixels)
    except BaseException:
        library.close()
        raise
    return replace(engine, library=library, pipeline=pipeline)


def _open_library(directory: Path, settings: Settings) -> Library:
    try:
        return load_library(directory, backend=settings.index, milvus=milvus_of(settings))
    except LibraryError as error:
        raise StartupError(str(error)) from error


def milvus_of(settings: Settings) -> MilvusSettings | None:
    """Where Milvus is, if the settings say so."""
    if settings.milvus_uri is None:
        return None
    token = settings.milvus_token
    return MilvusSettings(
        uri=settings.milvus_uri,
        token=token.get_secret_value() if token else "",
        timeout_s=settings.milvus_timeout_ms / 1e3,
    )


def _assemble(
    detector: PersonDetector,
    estimator: PoseEstimator,
    lifter: PoseLifter | None,
    library: Library,
    settings: Settings,
) -> Pipeline:
    return Pipeline(
        detector,
        estimator,
        Lifter(library, LiftingSettings(shortlist=settings.shortlist), lifter),
        max_pixels=settings.max_pixels,
        decode_side_px=settings.decode_side_px,
    )


def _warm_up(pipeline: Pipeline, max_pixels: int) -> float:
    """Run every stage a few times on a made-up photo; returns the fastest run in seconds.

    The photo has 640 x 480 pixels, or as many as photos may have. Raises ``StartupError`` when the
    library's index does not answer.
    """
    shrink = min(1.0, math.sqrt(max_pixels / (640 * 480)))
    height_px, width_px = int(480 * shrink), int(640 * shrink)
    noise = np.random.default_rng(0).integers(0, 255, (height_px, width_px, 3), np.uint8)
    _, encoded = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 5))
    data = encoded.tobytes()
    box_px = (width_px / 3, height_px / 12, width_px / 3, height_px * 5 / 6)
    durations_s = []
    for _ in range(_WARM_UP_RUNS):
        started_s = time.perf_counter()
        try:
            pipeline.estimate(data, PhotoQuery(max_people=1))
            pipeline.estimate(data, PhotoQuery(box_px=box_px))
        except LibraryUnavailableError as error:
            raise StartupError(str(error.__cause__)) from error
        durations_s.append(time.perf_counter() - started_s)
    return min(durations_s)
