"""From a guess to a pose: landmarks are looked for where the guess puts them, and the pose is refined.

In narrow windows corners are described along the orientation that the landmark was mapped with. What a corner
shows of its orientation is too often another one: half as many again are recognised so in another light or lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import refine_absolute_pose
from fleetmap.vision.matching import bits_apart, closest_of_pairs, match_by_projection, pairs_in_windows
from fleetmap.vision.upward import upward_deg
from fleetmap.visual_map import Landmarks
from fleetmap_localizer.gate import Fit
from fleetmap_localizer.image_uncertainty import relative_covariance
from fleetmap_localizer.local_map import Indices, Predictions
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.settings import FittingSettings

Array = NDArray[np.float64]


def fit_around(
    view: MapView,
    camera: Camera,
    image: QueryImage,
    map_from_cam: Pose,
    radii_px: Sequence[float],
    settings: FittingSettings,
) -> Fit | None:
    """Match the landmarks around a guess by projection and refine, in windows of one radius after the other."""
    around = view.local_map.landmarks_around(map_from_cam)
    fit = None
    for radius_px in radii_px:
        fit = _fit_once(view, camera, image, map_from_cam, around, radius_px, settings)
        if fit is None:
            return None
        map_from_cam = fit.answer.map_from_cam
    return None if fit is None else _with_honest_covariance(fit, view, camera)


def _fit_once(
    view: MapView,
    camera: Camera,
    image: QueryImage,
    map_from_cam: Pose,
    around: Indices,
    radius_px: float,
    settings: FittingSettings,
) -> Fit | None:
    group, features = view.content.landmarks, image.features
    predictions = view.local_map.predict(around, map_from_cam)
    if radius_px <= settings.max_oriented_radius_px and group.angles_deg is not None:
        found = match_along(group, predictions, map_from_cam, camera, image, radius_px, settings)
    else:
        found = match_by_projection(
            *_windows(predictions, camera, features.scale_factor, radius_px),
            group.descriptors[predictions.landmarks],
            features,
            settings.max_distance,
            settings.ratio,
        )
    seen, landmarks = found[found >= 0], predictions.landmarks[found >= 0]
    pixels = features.pixels[seen]
    answer = refine_absolute_pose(
        pixels, group.points_m[landmarks], features.sigmas_px[seen], camera, map_from_cam
    )
    if answer is None:
        return None
    return Fit(answer, landmarks, pixels, features.sigmas_px[seen], predictions.pixels, features.pixels)


def match_along(
    group: Landmarks,
    predictions: Predictions,
    map_from_cam: Pose,
    camera: Camera,
    image: QueryImage,
    radius_px: float,
    settings: FittingSettings,
) -> NDArray[np.int32]:
    """The feature that shows each landmark, (L,) or -1; corners are described as the landmark was."""
    assert group.angles_deg is not None
    features = image.features
    pairs = pairs_in_windows(*_windows(predictions, camera, features.scale_factor, radius_px), features)
    predicted, seen = pairs[:, 0], pairs[:, 1]
    landmarks = predictions.landmarks[predicted]
    upward = upward_deg(camera, predictions.pixels, map_from_cam.rotation[2])
    _, descriptors = image.describe_at(
        image.recorded_px[seen],
        features.octaves[seen].astype(np.int64),
        upward[predicted] + group.angles_deg[landmarks],
    )
    return closest_of_pairs(
        pairs,
        bits_apart(descriptors, group.descriptors[landmarks]),
        len(predictions.landmarks),
        features,
        settings.max_distance,
        settings.ratio,
    )


def _windows(
    predictions: Predictions, camera: Camera, scale_factor: float, radius_px: float
) -> tuple[Array, Array, Indices, Indices]:
    """Centres, radii, finest and coarsest octaves (L,) of where landmarks are looked for.

    Windows grow with the octave, and with what undistorting stretches at the rim of a wide lens.
    """
    radii_px = radius_px * scale_factor**predictions.octaves * camera.magnification(predictions.pixels)
    return predictions.pixels, radii_px, predictions.octaves - 1, predictions.octaves + 1


def _with_honest_covariance(fit: Fit, view: MapView, camera: Camera) -> Fit:
    """The solver's own covariance takes all landmarks for independent witnesses."""
    covariance = relative_covariance(fit, view.content.landmarks, camera)
    return replace(fit, answer=replace(fit.answer, covariance=covariance))
