"""What the localizer may be tuned by, one group per stage. Lengths in pixels refer to the finest octave."""

from __future__ import annotations

from dataclasses import dataclass, field

from fleetmap.vision.features import FeatureSettings
from fleetmap.vision.place_recognition import PlaceIndexSettings


@dataclass(frozen=True)
class LocalMapSettings:
    """Which landmarks are looked for around a predicted pose."""

    keyframes: int = 24  # nearest to the pose
    turn_weight_m: float = 6.0  # a keyframe turned by a radian counts as so much further away
    max_viewing_angle_deg: float = 70.0  # between the ray to a landmark and the rays it was mapped from


@dataclass(frozen=True)
class GateSettings:
    """What a pose must show before anything else is asked: no pose is better than a wrong one."""

    chance_ratio: float = 0.01  # of the landmarks that should be in view: how many may agree with a wrong pose
    max_chance: float = 1e-3  # that so many agree with a wrong pose, see fleetmap_localizer.gate.chance_of
    min_coverage: float = 0.3  # share of the view's cells, where landmarks are expected, in which some agree
    max_position_sigma_m: float = 0.3
    max_rotation_sigma_deg: float = 1.0
    min_inliers: int = 12  # for geometry's sake: six degrees of freedom, and how much they leave over
    min_inlier_ratio: float = 0.5  # inliers per matched landmark
    min_occupied_cells: int = 6  # of a grid of 8 x 4 over the image


@dataclass(frozen=True)
class FittingSettings:
    """How landmarks are matched around a guess of the pose."""

    max_distance: int = 64  # Hamming bits
    ratio: float = 0.9
    max_oriented_radius_px: float = 15.0  # in windows up to here corners are described as the landmarks were


@dataclass(frozen=True)
class RelocalizationSettings:
    """The search from nothing."""

    candidates: int = 24  # places tried
    min_score: float = 3.0  # of a place, in standard deviations of chance, to be tried
    min_rival_score: float = 0.35  # of that of a clear place; what is less alike is not tried any more
    neighbours: int = 8  # covisible keyframes that join a candidate
    min_shared_landmarks: int = 15  # to call two keyframes covisible
    max_landmarks: int = 800  # of a candidate
    max_distance: int = 64  # Hamming bits
    ratio: float = 0.85
    min_matches: int = 12
    min_ransac_inliers: int = 10
    ransac_error_px: float = 6.0
    radii_px: tuple[float, ...] = (12.0, 5.0)  # windows around the projections, round after round
    wide_radii_px: tuple[float, ...] = (60.0, 30.0, 12.0, 5.0)  # from a keyframe's pose
    side_steps_m: tuple[float, ...] = (-3.0, -1.5, 1.5, 3.0)  # looked at beside a pose that is not clear
    side_radii_px: tuple[float, ...] = (30.0, 12.0, 5.0)
    max_rival: float = 0.8  # another place with this share of the best's support makes the answer ambiguous
    min_lead_sigmas: float = 2.0  # of the best's inliers over those of a place that could be the answer as well
    min_place_score: float = -0.25  # log-odds; of near-identical streets one in twenty is taken for the right
    min_place_score_unoriented: float = 0.5  # the same for maps that do not tell descriptors' orientations
    clear_place_score: float = 3.5  # what has it ends the search, but for places that are as much alike
    min_score_lead: float = 3.0  # of the best over a rival, for the rival not to matter


@dataclass(frozen=True)
class TrackingSettings:
    """The search around a prediction."""

    max_gap_s: float = 1.0  # without a pose for longer, the place is searched for from nothing
    radii_px: tuple[tuple[float, ...], ...] = ((15.0, 5.0), (40.0, 12.0, 5.0))  # the second if the first fails
    min_kept_support: float = 0.6  # of the inliers before; with fewer, other places are looked at as well
    max_acceleration_mps2: float = 15.0  # a pose that the vehicle cannot have reached is not believed
    max_speed_mps: float = 80.0
    slack_m: float = 0.5
    min_vouched_support: float = 0.35  # of the inliers before; with fewer, the prediction vouches for nothing
    overruling_support: float = 2.0  # times the inliers before; a pose with more is believed against the motion


@dataclass(frozen=True)
class LocalizerSettings:
    """All groups together."""

    # Of 4,000 corners a third more landmarks find theirs in sparse maps than of 2,000, for 2 or 3 ms an image.
    features: FeatureSettings = field(default_factory=lambda: FeatureSettings(count=4000))
    place_index: PlaceIndexSettings = field(default_factory=PlaceIndexSettings)
    local_map: LocalMapSettings = field(default_factory=LocalMapSettings)
    gate: GateSettings = field(default_factory=GateSettings)
    fitting: FittingSettings = field(default_factory=FittingSettings)
    relocalization: RelocalizationSettings = field(default_factory=RelocalizationSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
