"""From a guess to a pose: landmarks are looked for where the guess puts them, and the pose is refined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap.vision.absolute_pose import refine_absolute_pose
from fleetmap.vision.features import Features
from fleetmap.vision.matching import match_by_projection
from fleetmap_localizer.gate import Fit
from fleetmap_localizer.image_uncertainty import relative_covariance
from fleetmap_localizer.local_map import Indices
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.settings import FittingSettings


def fit_around(
    view: MapView,
    camera: Camera,
    features: Features,
    map_from_cam: Pose,
    radii_px: Sequence[float],
    settings: FittingSettings,
) -> Fit | None:
    """Match the landmarks around a guess by projection and refine, in windows of one radius after the other."""
    around = view.local_map.landmarks_around(map_from_cam)
    fit = None
    for radius_px in radii_px:
        fit = _fit_once(view, camera, features, map_from_cam, around, radius_px, settings)
        if fit is None:
            return None
        map_from_cam = fit.answer.map_from_cam
    return None if fit is None else _with_honest_covariance(fit, view, camera)


def _fit_once(
    view: MapView,
    camera: Camera,
    features: Features,
    map_from_cam: Pose,
    around: Indices,
    radius_px: float,
    settings: FittingSettings,
) -> Fit | None:
    """Windows grow with the octave, and with what undistorting stretches at the rim of a wide lens."""
    group = view.content.landmarks
    predictions = view.local_map.predict(around, map_from_cam)
    stretch = features.scale_factor**predictions.octaves * camera.magnification(predictions.pixels)
    found = match_by_projection(
        predictions.pixels,
        np.asarray(radius_px * stretch, dtype=np.float64),
        predictions.octaves - 1,
        predictions.octaves + 1,
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


def _with_honest_covariance(fit: Fit, view: MapView, camera: Camera) -> Fit:
    """The solver's own covariance takes all landmarks for independent witnesses."""
    covariance = relative_covariance(fit, view.content.landmarks, camera)
    return replace(fit, answer=replace(fit.answer, covariance=covariance))
