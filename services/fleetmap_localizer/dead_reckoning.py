"""Where the vehicle is while its camera cannot tell: other sensors carry the last measured poses on.

What drives it is the IMU where there is one; without it wheel speeds, or fixes if they may be used. With none of
them there is no prediction: that a vehicle went on as before would be a guess.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fleetmap.drive import Drive, GnssFix, WheelSpeed
from fleetmap.errors import InputError
from fleetmap.geometry import CAM_FROM_BODY, Pose
from fleetmap_localizer.filter_settings import DeadReckoningSettings
from fleetmap_localizer.pose_estimate import PoseEstimate
from fleetmap_localizer.sensor_streams import ImuStream, SensorStream

if TYPE_CHECKING:  # the filter is compiled code: drives without such sensors start without it
    from fleetmap_localizer.motion_filter import MotionFilter, Rig

Array = NDArray[np.float64]


class DeadReckoning:
    """Takes in measured poses and tells predicted ones; stamps may only grow from call to call."""

    def __init__(
        self,
        rig: Rig,
        *,
        imu: ImuStream | None,
        wheels: SensorStream[WheelSpeed],
        fixes: SensorStream[GnssFix],
        settings: DeadReckoningSettings,
    ) -> None:
        self._rig, self._settings = rig, settings
        self._imu, self._wheels, self._fixes = imu, wheels, fixes
        self._filter: MotionFilter | None = None  # none before two poses, and after it has been wrong
        self._at_ns = -(2**63)  # of the filter, and of all calls so far
        self._wheels_ns = self._heard_ns = self._at_ns
        self._last: PoseEstimate | None = None  # measured
        self._contradictions = 0

    @staticmethod
    def for_drive(
        drive: Drive, *, use_gnss: bool, settings: DeadReckoningSettings | None = None
    ) -> DeadReckoning | None:
        """Reckon with what a drive has recorded; None if that is nothing.

        Args:
            drive: its sensors are read as its images go by, GNSS fixes only with ``use_gnss``.
            use_gnss: whether fixes may be used.
            settings: of the filter.

        Raises:
            DriveError: damaged messages, or several receivers and none was chosen.
        """
        settings = settings or DeadReckoningSettings()
        mounting, vehicle = drive.imu_mounting(), drive.wheel_mounting()
        fixes = drive.gnss_fixes() if use_gnss else []
        if mounting is None and vehicle is None and not fixes:
            return None
        from fleetmap_localizer.motion_filter import Rig

        cam_from_vehicle = vehicle.cam_from_sensor if vehicle else Pose(CAM_FROM_BODY, np.zeros(3))
        cam_from_base = mounting.cam_from_sensor if mounting else cam_from_vehicle
        base_from_cam = cam_from_base.inverse()
        rig = Rig(
            base_from_cam=base_from_cam,
            vehicle_from_base=cam_from_vehicle.inverse() @ cam_from_base,
            antenna_in_base_m=base_from_cam.transform(drive.antenna().position_in_cam_m if fixes else np.zeros(3)),
            has_wheels=vehicle is not None,
            is_mounting_known=vehicle is not None and not vehicle.source.startswith("assumed"),
        )
        return DeadReckoning(
            rig,
            imu=ImuStream(drive.imu_samples(), settings.imu.longest_pause_s) if mounting else None,
            wheels=SensorStream(drive.wheel_speeds()),
            fixes=SensorStream(fixes),
            settings=settings,
        )

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """The predicted pose of the camera at an image that gave none; None where it is not known well enough.

        Raises:
            InputError: a stamp before that of an earlier call.
        """
        self._go_on_to(stamp_ns)
        if self._filter is None or self._last is None or self._contradictions or self._is_silent():
            return None
        utm_from_cam, covariance = self._filter.camera_pose()
        covariance = covariance + _turned(self._common(), self._last.utm_from_cam, utm_from_cam)
        if not self._is_worth_telling(covariance):
            return None
        return PoseEstimate(
            stamp_ns=stamp_ns,
            epsg=self._last.epsg,
            utm_from_cam=utm_from_cam,
            covariance=0.5 * (covariance + covariance.T),
            map_id=self._last.map_id,
            version=self._last.version,
            inlier_count=0,
            kind="predicted",
        )

    def measured(self, pose: PoseEstimate) -> PoseEstimate:
        """Take in a measured pose; it comes back as it is, for it stays the camera's own.

        Raises:
            InputError: a stamp before that of an earlier call.
        """
        self._go_on_to(pose.stamp_ns)
        if self._filter is not None and self._last is not None:
            self._contradictions = 0 if self._is_taken(pose) else self._contradictions + 1
            if self._contradictions >= self._settings.patience:
                self._filter = None  # so many poses are not all wrong
        if self._filter is None and self._last is not None:
            self._start(self._last, pose)
        self._last = pose
        return pose

    def _start(self, first: PoseEstimate, second: PoseEstimate) -> None:
        from fleetmap_localizer.filter_start import start_filter

        has_imu = self._imu is not None
        self._filter = start_filter(first, second, self._rig, has_imu=has_imu, settings=self._settings)
        self._contradictions = 0
        self._wheels_ns = self._heard_ns = second.stamp_ns

    def _is_taken(self, pose: PoseEstimate) -> bool:
        """Whether the filter could take in a measured pose."""
        assert self._filter is not None
        assert self._last is not None
        if pose.epsg != self._last.epsg:
            self._filter = None
            return True
        before = self._common()
        common = self._settings.common_share * pose.covariance
        if (pose.map_id, pose.version) != (self._last.map_id, self._last.version):
            self._filter.doubt_pose(before + common)  # the two maps' errors are not the same
        own = (1.0 - self._settings.common_share) * pose.covariance
        return self._filter.correct_by_pose(pose.utm_from_cam, own, common, before)

    def _common(self) -> Array:
        """What of the last measured pose's covariance (6, 6) its neighbours share."""
        assert self._last is not None
        return self._settings.common_share * self._last.covariance

    def _go_on_to(self, stamp_ns: int) -> None:
        """Predict up to an image, taking in on the way what wheels and receiver say."""
        if stamp_ns < self._at_ns:
            raise InputError(f"an image at {stamp_ns} ns comes after one at {self._at_ns} ns; sort them by time")
        while self._filter is not None and self._at_ns < stamp_ns:
            event_ns = self._next_event_ns(stamp_ns)
            self._predict_to(self._filter, stamp_ns if event_ns is None else event_ns)
            if self._filter is not None and event_ns is not None:
                self._take_in(self._filter, event_ns)
        self._at_ns = stamp_ns
        if self._filter is None:
            for stream in (self._wheels, self._fixes, self._imu):
                if stream is not None:
                    stream.skip_until(stamp_ns)

    def _next_event_ns(self, stamp_ns: int) -> int | None:
        """When the next wheel speed or fix comes that counts; None if not before a stamp."""
        self._wheels.skip_until(self._wheels_ns + round(self._settings.wheel.least_interval_s * 1e9) - 1)
        coming = [stream.next.stamp_ns for stream in (self._wheels, self._fixes) if stream.next is not None]
        return min((event_ns for event_ns in coming if event_ns <= stamp_ns), default=None)

    def _predict_to(self, motion: MotionFilter, stamp_ns: int) -> None:
        if self._imu is None:
            motion.predict_turning((stamp_ns - self._at_ns) * 1e-9)
        else:
            for piece in self._imu.between(self._at_ns, stamp_ns):
                if piece is None:
                    self._filter = None
                    return
                motion.predict_inertial(*piece)
        self._at_ns = stamp_ns

    def _take_in(self, motion: MotionFilter, stamp_ns: int) -> None:
        """Correct the filter by what is due."""
        speed, fix = self._wheels.take_until(stamp_ns), self._fixes.take_until(stamp_ns)
        if speed is not None and motion.correct_by_wheels(speed.speed_mps, self._since_wheels_s(stamp_ns)):
            self._heard_ns = stamp_ns
        if fix is not None and motion.correct_by_fix(fix):
            self._heard_ns = stamp_ns
            if not self._rig.has_wheels and motion.speed_mps > self._settings.gnss.side_speed_mps:
                motion.correct_by_wheels(None, self._since_wheels_s(stamp_ns))

    def _since_wheels_s(self, stamp_ns: int) -> float:
        since_s = (stamp_ns - self._wheels_ns) * 1e-9
        self._wheels_ns = stamp_ns
        return since_s

    def _is_silent(self) -> bool:
        """Whether nothing drives the filter any more."""
        return self._imu is None and (self._at_ns - self._heard_ns) * 1e-9 > self._settings.longest_silence_s

    def _is_worth_telling(self, covariance: Array) -> bool:
        rotation_rad, position_m = (
            float(np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1])) for part in (slice(0, 3), slice(3, 6))
        )
        settings = self._settings
        return (
            position_m <= settings.max_position_sigma_m
            and np.degrees(rotation_rad) <= settings.max_rotation_sigma_deg
        )


def _turned(covariance: Array, utm_from_first: Pose, utm_from_second: Pose) -> Array:
    """A covariance (6, 6) of one camera's tangent for errors that are the same, in the grid, of another's."""
    second_from_first = np.kron(np.eye(2), utm_from_second.rotation.T @ utm_from_first.rotation)
    return second_from_first @ covariance @ second_from_first.T
