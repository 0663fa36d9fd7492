"""Following: the landmarks are looked for around where the vehicle should be by now."""

from __future__ import annotations

from fleetmap.camera import Camera
from fleetmap.geometry import Pose
from fleetmap_localizer.fitting import fit_around
from fleetmap_localizer.gate import Fit, is_trustworthy
from fleetmap_localizer.map_view import MapView
from fleetmap_localizer.motion import Motion
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.relocalization import judged
from fleetmap_localizer.settings import LocalizerSettings


def track(
    view: MapView, camera: Camera, image: QueryImage, motion: Motion, settings: LocalizerSettings
) -> Fit | None:
    """The pose that continues a motion; None where none does, as in maps of elsewhere or of another zone."""
    if motion.epsg != view.anchor.epsg:
        return None
    utm_from_cam = motion.predict(image.stamp_ns)
    predicted = Pose(utm_from_cam.rotation, view.anchor.map_from_utm(utm_from_cam.translation_m))
    if not view.reaches(predicted.translation_m):
        return None
    best = None
    for radii_px in settings.tracking.radii_px:
        fit = fit_around(view, camera, image, predicted, radii_px, settings.fitting)
        if fit is not None and _continues(view, camera, image, motion, fit, settings):
            best = fit if best is None else max(best, fit, key=lambda each: each.answer.inlier_count)
        if best is not None and not has_lost_support(best, motion, settings):
            break
    return best


def has_lost_support(fit: Fit, motion: Motion, settings: LocalizerSettings) -> bool:
    """Whether far fewer landmarks agree than on the image before.

    In wide windows some landmarks always find a partner, and those may agree on a wrong pose.
    """
    return fit.answer.inlier_count < settings.tracking.min_kept_support * motion.inlier_count


def can_reach(view: MapView, motion: Motion, stamp_ns: int, fit: Fit, settings: LocalizerSettings) -> bool:
    """Whether the vehicle can be there by then."""
    position_m = view.anchor.utm_from_map(fit.answer.map_from_cam.translation_m)
    return motion.epsg != view.anchor.epsg or motion.can_reach(stamp_ns, position_m, settings.tracking)


def _continues(
    view: MapView, camera: Camera, image: QueryImage, motion: Motion, fit: Fit, settings: LocalizerSettings
) -> bool:
    """Whether a pose near the prediction is its continuation.

    A prediction from images before vouches for the place, though traffic may hide half the view. Where most of the
    support is gone the view may be of something else: as much is asked as from nothing.
    """
    if not can_reach(view, motion, image.stamp_ns, fit, settings):
        return False
    if fit.answer.inlier_count >= settings.tracking.min_vouched_support * motion.inlier_count:
        return is_trustworthy(fit, camera, settings.gate)
    return judged(view, camera, image, fit, settings).is_trusted
