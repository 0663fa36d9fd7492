"""What a camera sees of a scene: images, and the truth behind each pixel.

Smooth outlines come from deciding visibility at four places of each pixel and mixing what they see; inside an
outline the pixel's one texel is right already ("multisampling"; K. Akeley, RealityEngine Graphics, SIGGRAPH 1993).
Any lens that ``Camera`` knows is drawn directly, up to where it says that nothing is imaged (88 degrees off axis).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.geometry import Pose, interpolate_pose
from fleetmap.simulation.look import Look
from fleetmap.simulation.planes import planes_in_cam, surfaces_in_cone
from fleetmap.simulation.rays import BAND_ROWS, first_sample, ray_table
from fleetmap.simulation.shading import SKY_GREY, Paint, shade
from fleetmap.simulation.view import Scene, View, view_of
from fleetmap.simulation.visibility import NOTHING, first_hits
from fleetmap.simulation.wetness import mirrored_camera, road_plane, wet_the_ground

Array = NDArray[np.float64]
FloatImage = NDArray[np.float32]

_SAMPLES_PX = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])  # a rotated grid
_CENTRE_PX = np.zeros((1, 2))


def render(scene: Scene, camera: Camera, map_from_cam: Pose, look: Look) -> NDArray[np.uint8]:
    """The image (H, W) that a camera takes; pixel (0, 0) is the centre of the top-left pixel."""
    return look.apply(_light(scene, camera, [map_from_cam], look), map_from_cam)


def render_rolling_shutter(
    scene: Scene, camera: Camera, first_row: Pose, last_row: Pose, look: Look
) -> NDArray[np.uint8]:
    """The image (H, W) of a camera that reads its rows one after the other while it moves.

    ``first_row`` and ``last_row`` are ``map_from_cam`` when the first and the last row are exposed; in between the
    camera moves evenly, which it does within the few hundredths of a second that a sensor's readout takes. The
    pose is kept for ``rays.BAND_ROWS`` rows at a time.
    """
    bands = -(-camera.height_px // BAND_ROWS)
    middle_rows = np.minimum(np.arange(bands) * BAND_ROWS + 0.5 * (BAND_ROWS - 1), camera.height_px - 1)
    fractions = middle_rows / max(camera.height_px - 1, 1)
    poses = [interpolate_pose(first_row, last_row, float(fraction)) for fraction in fractions]
    return look.apply(_light(scene, camera, poses, look), first_row)


def render_depth(scene: Scene, camera: Camera, map_from_cam: Pose) -> FloatImage:
    """Depth (H, W) along the optical axis in metres at the pixel centres; infinite where the sky is."""
    view = view_of(scene, ray_table(camera), [map_from_cam], _CENTRE_PX)
    inverse_m = first_sample(view.nearest, camera)
    pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    rays = camera.unproject(pixels.reshape(-1, 2).astype(np.float64))
    along_axis = 1.0 / np.linalg.norm(rays, axis=1).reshape(camera.height_px, camera.width_px)
    with np.errstate(divide="ignore"):
        depth = along_axis / inverse_m
    return np.asarray(np.where(inverse_m > 0.0, depth, np.inf), dtype=np.float32)


def true_points(scene: Scene, camera: Camera, map_from_cam: Pose, pixels: Array) -> Array:
    """Where the viewing rays of distorted pixels (N, 2) meet the scene: map points (N, 3).

    NaN for the sky and for pixels outside the image. A pixel within half a pixel of an outline may be given to
    either side of it.
    """
    ids = surface_ids(scene, camera, map_from_cam)
    inside = camera.is_inside(pixels, -0.5)
    column, row = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(np.int64).T
    hit = ids[row.clip(0, camera.height_px - 1), column.clip(0, camera.width_px - 1)]
    corners = scene.surfaces.corners_in_map[hit]
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    rays_in_map = camera.unproject(pixels) @ map_from_cam.rotation.T
    height = np.einsum("ni,ni->n", normals, corners[:, 0] - map_from_cam.translation_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = height / np.einsum("ni,ni->n", normals, rays_in_map)
    distance[~inside | (hit == NOTHING)] = np.nan
    return np.asarray(map_from_cam.translation_m + rays_in_map * distance[:, None])


def cast_rays(scene: Scene, map_from_sensor: Pose, directions: Array, max_range_m: float = np.inf) -> Array:
    """Distances (N,) to the first surface along rays (N, 3) in a sensor's frame; infinite where there is none.

    Computed in double precision, without pixels: for range sensors. Leaves are hit where their texture is solid,
    and walls from their front only, as by :func:`render`.
    """
    surfaces, centre = scene.surfaces, map_from_sensor.translation_m
    rays = np.ascontiguousarray(directions / np.linalg.norm(directions, axis=1, keepdims=True), dtype=np.float64)
    ids, nearest_m = surfaces_in_cone(
        surfaces, centre, map_from_sensor.rotation[:, 2], widest_rad=np.pi, farthest_m=max_range_m
    )
    (planes,) = planes_in_cam(surfaces, ids, (map_from_sensor,), np.float64)
    textures, opacities = surfaces.texture_indices[ids], scene.atlas.packed_opacities
    return np.asarray(first_hits(planes, nearest_m, textures, opacities, rays, float(max_range_m)))


def surface_ids(scene: Scene, camera: Camera, map_from_cam: Pose) -> NDArray[np.int32]:
    """Indices (H, W) of the surfaces at the pixel centres, NOTHING (-1) for the sky."""
    view = view_of(scene, ray_table(camera), [map_from_cam], _CENTRE_PX)
    ids: NDArray[np.int32] = np.append(view.ids, NOTHING).astype(np.int32)  # index -1 finds NOTHING
    return np.asarray(ids[first_sample(view.seen, camera)])


def _light(scene: Scene, camera: Camera, poses: list[Pose], look: Look) -> FloatImage:
    """The light (H, W) that falls on the sensor; 255 is what saturates it at an exposure of 1."""
    view, light = _dry_light(scene, camera, poses, look)
    if look.wetness > 0.0:
        pose = poses[len(poses) // 2]
        from_here = Pose(np.eye(3), pose.translation_m)
        plane = road_plane(lambda rays_in_map: cast_rays(scene, from_here, rays_in_map), pose)
        if plane is not None:
            coarse_camera, mirrored_pose = mirrored_camera(camera, pose, plane)
            _, mirror = _dry_light(scene, coarse_camera, [mirrored_pose], look)
            wet_the_ground(light, mirror, look.wetness, scene.surfaces, view, pose, plane)
    return light


def _dry_light(scene: Scene, camera: Camera, poses: list[Pose], look: Look) -> tuple[View, FloatImage]:
    view = view_of(scene, ray_table(camera), poses, _SAMPLES_PX)
    light = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    shade(view.planes, _paint(scene, view.ids, look), view.table, view.samples_px, view.seen, light)
    return view, light


def _paint(scene: Scene, ids: NDArray[np.int64], look: Look) -> Paint:
    surfaces, textures = scene.surfaces, scene.surfaces.texture_indices[ids]
    return Paint(
        scene.atlas.pixels,
        scene.atlas.origins_px[textures],
        scene.atlas.sizes_px[textures],
        look.surface_light(surfaces.brightness[ids], surfaces.is_lamp[ids]).astype(np.float32),
        np.float32(SKY_GREY * look.daylight * look.sky),
    )
