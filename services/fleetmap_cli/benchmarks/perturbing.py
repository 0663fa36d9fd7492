"""``python -m fleetmap_cli.benchmarks.perturbing IN.mcap OUT.mcap``: a recording as other eyes would have seen it.

Darkened, noisy, from a camera turned to the side, at half the resolution, or every second image only. Fixes stay,
and the reference beside the recording becomes that of the new camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import click
import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.drives import open_drive
from fleetmap.drives.ros2_writer import DriveWriter
from fleetmap.geometry import Pose, so3_exp
from fleetmap.trajectory import Trajectory, read_trajectory, write_trajectory

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_FILE = click.Path(path_type=Path, dir_okay=False)
_GNSS_FRAME = "gnss"


@dataclass(frozen=True)
class Perturbation:
    """What is done to every image."""

    gamma: float = 1.0  # grey levels become 255 (g / 255)^gamma: above 1 is darker
    noise_sigma: float = 0.0  # grey levels, white
    yaw_deg: float = 0.0  # the camera turned to the right about its own vertical axis
    half: bool = False  # resolution

    def camera(self, camera: Camera) -> Camera:
        """The calibration of the new images. Only the resolution changes it."""
        return halved(camera) if self.half else camera

    def apply(self, image: Image, camera: Camera, rng: np.random.Generator) -> Image:
        """The new image of the scene, from an image of ``camera``."""
        if self.yaw_deg:
            image = turned(image, camera, self.yaw_deg)
        if self.half:
            size = camera.width_px // 2, camera.height_px // 2
            even = image[: 2 * size[1], : 2 * size[0]]
            image = np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        levels = 255.0 * (image / 255.0) ** self.gamma
        levels += rng.normal(0.0, self.noise_sigma, image.shape)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def turned(image: Image, camera: Camera, yaw_deg: float) -> Image:
    """What the same camera would see, turned about its centre: the homography K R K^-1 between undistorted pixels.

    Black where the old image does not reach.
    """
    columns, rows = _sources_px(camera, yaw_deg)
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), dtype=np.uint8)


@lru_cache(maxsize=1)
def _sources_px(camera: Camera, yaw_deg: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row (H, W) in the old image of every pixel of the new one; far outside where there is none."""
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=2)
    rays_in_new = camera.unproject(grid.reshape(-1, 2).astype(np.float64))
    sources = camera.project(rays_in_new @ cam_from_turned(yaw_deg).T)
    sources = np.where(np.isfinite(sources), sources, -1e4).reshape(camera.height_px, camera.width_px, 2)
    return sources[..., 0].astype(np.float32), sources[..., 1].astype(np.float32)


def cam_from_turned(yaw_deg: float) -> Array:
    """Rotation (3, 3) of a camera turned to the right about its own vertical axis, in the camera as it was."""
    return so3_exp(np.array([0.0, np.radians(yaw_deg), 0.0]))


def halved(camera: Camera) -> Camera:
    """The camera of images whose pixels are the means of 2 x 2: pixel i lies at 2 i + 0.5 of the old ones."""
    return replace(
        camera,
        width_px=camera.width_px // 2,
        height_px=camera.height_px // 2,
        fx_px=camera.fx_px / 2.0,
        fy_px=camera.fy_px / 2.0,
        cx_px=(camera.cx_px - 0.5) / 2.0,
        cy_px=(camera.cy_px - 0.5) / 2.0,
    )


@click.command()
@click.argument("source", metavar="IN.mcap", type=_FILE)
@click.argument("target", metavar="OUT.mcap", type=_FILE)
@click.option("--gamma", type=float, default=1.0, help="Above 1 is darker.")
@click.option("--noise", type=float, default=0.0, help="Sigma of white noise in grey levels.")
@click.option("--yaw-deg", type=float, default=0.0, help="Turn the camera to the right.")
@click.option("--half", is_flag=True, help="Halve the resolution.")
@click.option("--images", type=click.Choice(["all", "even", "odd"]), default="all", help="Which of them to keep.")
def perturb(
    source: Path, target: Path, gamma: float, noise: float, yaw_deg: float, half: bool, images: str
) -> None:
    """Write OUT.mcap, and OUT.reference.tum where IN.reference.tum is there."""
    change = Perturbation(gamma, noise, yaw_deg, half)
    drive, cam_from_new = open_drive(source), cam_from_turned(yaw_deg)
    rng = np.random.default_rng(0)
    with DriveWriter(target, change.camera(drive.camera), force=True) as writer:
        stamps_ns = []
        for frame in _chosen(drive.frames(), images):
            stamps_ns.append(frame.stamp_ns)
            writer.write_image(frame.stamp_ns, change.apply(frame.image, drive.camera, rng), png=True)
        if fixes := drive.gnss_fixes():
            arm_m = drive.antenna().position_in_cam_m
            writer.write_static_transform("camera", _GNSS_FRAME, Pose(np.eye(3), arm_m @ cam_from_new))
            for fix in fixes:
                writer.write_fix(fix, _GNSS_FRAME)
    reference = source.with_suffix(".reference.tum")
    if reference.exists():
        seen = _at(read_trajectory(reference), np.array(stamps_ns))
        turned_seen = replace(seen, rotations=seen.rotations @ cam_from_new)
        write_trajectory(target.with_suffix(".reference.tum"), turned_seen)


def _chosen(frames: Iterator[Frame], images: str) -> Iterator[Frame]:
    first, step = {"all": (0, 1), "even": (0, 2), "odd": (1, 2)}[images]
    return islice(frames, first, None, step)


def _at(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """Its poses at some stamps; TUM text keeps microseconds."""
    kept = np.isin((trajectory.stamps_ns + 500) // 1000, (stamps_ns + 500) // 1000)
    return replace(
        trajectory,
        stamps_ns=trajectory.stamps_ns[kept],
        positions_m=trajectory.positions_m[kept],
        rotations=trajectory.rotations[kept],
    )


if __name__ == "__main__":
    perturb()
