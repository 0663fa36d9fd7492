"""Every knob of the mapper in one place; written into each map's provenance."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

CalibrationMode = Literal["recorded", "auto", "refined"]
LEAST_BUDGET_MB_PER_KM = 0.05
GnssMode = Literal["none", "mapping", "final", "full"]


class _Group(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FeatureGroup(_Group):
    """What is extracted from every image."""

    count: int = Field(default=4000, ge=200, le=10_000)


class InitialisationGroup(_Group):
    """When two views make a first map."""

    min_matches: int = 100
    min_points: int = 60


class TrackingGroup(_Group):
    """How a frame is held against the local map."""

    search_radius_px: float = 15.0  # about the position predicted by constant velocity, at octave 0
    refined_radius_px: float = 4.0  # about the position predicted by the first pose
    min_inliers: int = 25
    max_hamming: int = 80
    match_ratio: float = 0.9
    local_keyframes: int = 25
    patience_frames: int = 10  # lost for so long, a new segment is tried beside the old map


class KeyframeGroup(_Group):
    """When a frame becomes a keyframe: whichever comes first."""

    min_tracked_ratio: float = 0.8  # of what the last keyframe held
    max_rotation_deg: float = 4.0
    max_translation_to_depth: float = 0.08  # against the median depth of the tracked landmarks


class MappingGroup(_Group):
    """How a new keyframe extends and tightens the map."""

    neighbours: int = 12  # keyframes that new landmarks are triangulated with
    min_parallax_px: float = 10.0  # angle between the rays, expressed at the image centre
    max_hamming: int = 60
    window: int = 16  # keyframes that the local adjustment moves
    min_observations: int = 3  # a landmark that never gets there is dropped


class GnssGroup(_Group):
    """How fixes enter."""

    mode: GnssMode = "full"
    align_every: int = 5  # keyframes between two light alignments while mapping
    align_window: int = Field(default=300, ge=10)  # keyframes that such an alignment moves; older ones stay
    level_sigma_deg: float = 0.5  # how level the camera's horizontal axis is taken to be, averaged over a drive
    reject_outliers: bool = True  # fixes that are metres off though they claim to be good
    estimate_clock_offset: bool = True  # between camera and receiver; taken off where the drive proves it


class CalibrationGroup(_Group):
    """The camera's calibration: how far a recorded one may be off, and when the drive contradicts it.

    The sigmas of a calibration made in a workshop, on another day: they hold what a drive does not determine.
    """

    # recorded: taken as it is. refined: estimated together with poses and landmarks. auto: refined where the drive
    # contradicts the recorded one clearly, see adopt_*.
    mode: CalibrationMode = "auto"
    adopt_sigmas: float = 4.0  # a disagreement is acted upon that is as clear as this ...
    adopt_border_px: float = 0.5  # ... and shifts pixels at the image border by as much
    focal_sigma_ratio: float = Field(default=0.03, gt=0.0)  # of the focal length
    aspect_sigma_ratio: float = Field(default=0.002, gt=0.0)  # of fx against fy: how square pixels are
    centre_sigma_ratio: float = Field(default=0.015, gt=0.0)  # of the image width
    distortion_sigma_ratio: float = Field(default=0.015, gt=0.0)  # of the image width, at its farthest corner
    warn_sigmas: float = 4.0  # a disagreement is told that is as clear as this ...
    warn_border_px: float = 2.0  # ... and shifts pixels at the image border by as much


class QualityGroup(_Group):
    """When a map is fit to publish, and which stretches of its road are weak.

    Reprojection errors count in sigmas of a feature, which are pixels in the finest octave of the image.
    """

    min_posed_ratio: float = Field(default=0.95, ge=0.0, le=1.0)  # of all images
    max_unposed_gap_s: float = Field(default=5.0, ge=0.0)
    max_reprojection_rms_px: float = Field(default=2.0, ge=0.0)
    max_gnss_residual_sigmas: float = Field(default=4.0, ge=0.0)  # median of all fixes, over their own
    max_position_sigma_m: float = Field(default=2.0, ge=0.0)  # horizontal; 95 % of the keyframes must be better
    min_landmarks_per_m: float = Field(default=5.0, ge=0.0)  # over the whole road
    max_weak_ratio: float = Field(default=0.5, ge=0.0, le=1.0)  # of the road that weak stretches may take

    weak_position_sigma_m: float = Field(default=1.0, ge=0.0)  # horizontal, of a keyframe
    weak_reprojection_rms_px: float = Field(default=2.0, ge=0.0)  # of a keyframe
    weak_gnss_sigmas: float = Field(default=4.0, ge=0.0)  # median of five fixes in a row
    weak_landmarks_per_m: float = Field(default=5.0, ge=0.0)  # on ten metres
    weak_landmarks_per_image: int = Field(default=40, ge=0)  # seen by a keyframe
    weak_gap_s: float = Field(default=0.5, ge=0.0)  # without a posed image, while the vehicle moves
    weak_ties: int = Field(default=20, ge=0)  # landmarks seen from both before and after a place


class CellGroup(_Group):
    """What of the map goes into the cells that localizers fetch; the whole of it stays in the full part."""

    budget_mb_per_km: float = Field(default=1.0, ge=0.0)  # of all cells, on the keyframes' way; 0 keeps everything

    @field_validator("budget_mb_per_km")
    @classmethod
    def _has_room_for_keyframes(cls, budget_mb_per_km: float) -> float:
        if 0.0 < budget_mb_per_km < LEAST_BUDGET_MB_PER_KM:
            raise ValueError(f"must be 0 or at least {LEAST_BUDGET_MB_PER_KM:g}: keyframes need some room")
        return budget_mb_per_km


class MapperSettings(_Group):
    """All groups."""

    seed: int = 0
    features: FeatureGroup = FeatureGroup()
    initialisation: InitialisationGroup = InitialisationGroup()
    tracking: TrackingGroup = TrackingGroup()
    keyframes: KeyframeGroup = KeyframeGroup()
    mapping: MappingGroup = MappingGroup()
    cells: CellGroup = CellGroup()
    gnss: GnssGroup = GnssGroup()
    calibration: CalibrationGroup = CalibrationGroup()
    quality: QualityGroup = QualityGroup()
