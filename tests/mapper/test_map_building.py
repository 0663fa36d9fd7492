"""The finished map of the survey drive holds together."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fleetmap.vision.features import FeatureExtractor, FeatureSettings
from fleetmap.vision.upward import upward_deg
from fleetmap_mapper.settings import MapperSettings


def test_observations_are_sorted_and_name_what_is_there(mapped):
    content = mapped.visual_map
    seen = content.observations
    assert np.all(np.diff(seen.keyframe_index) >= 0)
    assert set(np.unique(seen.keyframe_index)) == set(range(len(content.keyframes)))
    assert set(np.unique(seen.landmark_index)) == set(range(len(content.landmarks)))
    assert np.all(np.bincount(seen.landmark_index) >= 2)
    pairs = seen.keyframe_index.astype(np.int64) * len(content.landmarks) + seen.landmark_index
    assert len(np.unique(pairs)) == len(pairs)


def test_keyframes_are_images_of_the_trajectory(mapped):
    keyframes, trajectory = mapped.visual_map.keyframes, mapped.trajectory
    rows = np.searchsorted(trajectory.stamps_ns, keyframes.stamps_ns)
    np.testing.assert_array_equal(trajectory.stamps_ns[rows], keyframes.stamps_ns)
    np.testing.assert_allclose(
        mapped.visual_map.anchor.utm_from_map(keyframes.positions_m), trajectory.positions_m[rows], atol=1e-6
    )
    np.testing.assert_allclose(keyframes.rotations, trajectory.rotations[rows], atol=1e-9)
    for R in trajectory.rotations:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def test_every_landmark_projects_to_where_it_was_seen(mapped):
    content, every = mapped.visual_map, []
    for k in range(len(content.keyframes)):
        rows = content.observations.keyframe_index == k
        points = content.landmarks.points_m[content.observations.landmark_index[rows]]
        pixels = content.camera.project_ideal(content.keyframes.pose(k).inverse().transform(points))
        sigmas = 1.2 ** content.observations.octaves[rows].astype(np.float64)
        errors = np.linalg.norm(pixels - content.observations.pixels[rows], axis=1) / sigmas
        every.append(errors)
    errors = np.concatenate(every)
    assert 0.01 < np.median(errors) < 0.3  # aligned patches
    within = 2.4477  # 95 % of chi-square with two degrees of freedom
    assert np.percentile(errors, 99) < within
    assert errors.max() < 1.5 * within  # corners that could not be aligned are less exact than one pixel


def test_a_landmarks_descriptor_is_one_of_its_own_with_octave_distance_and_orientation(survey_drive, mapped):
    """Extracted again from its images: the medoid is one of the track's descriptors, and stands with its data."""
    content = mapped.visual_map
    extractor = FeatureExtractor(survey_drive.camera, FeatureSettings(count=MapperSettings().features.count))
    index_of = {frame.stamp_ns: i for i, frame in enumerate(survey_drive.images)}
    observations, landmarks = content.observations, content.landmarks
    found = np.zeros(len(landmarks), bool)
    for k in range(len(content.keyframes)):
        features = extractor.extract(survey_drive.images[index_of[int(content.keyframes.stamps_ns[k])]].image)
        rows = np.flatnonzero(observations.keyframe_index == k)
        places = cKDTree(np.column_stack([features.pixels, 10.0 * features.octaves]))
        seen = np.column_stack([observations.pixels[rows], 10.0 * observations.octaves[rows]])
        _, near = places.query(seen, k=4)  # aligned by a pixel or so, a corner may have come closer to another one
        ids = observations.landmark_index[rows]
        upward = upward_deg(content.camera, observations.pixels[rows], content.keyframes.rotations[k][2])
        turned = features.angles_deg[near] - (upward + landmarks.angles_deg[ids])[:, None]
        is_own = (features.descriptors[near] == landmarks.descriptors[ids][:, None]).all(axis=2)
        away = np.linalg.norm(landmarks.points_m[ids] - content.keyframes.positions_m[k], axis=1)
        found[ids] |= (
            (is_own & (np.cos(np.radians(turned)) > np.cos(np.radians(0.5)))).any(axis=1)
            & (observations.octaves[rows] == landmarks.octaves[ids])
            & (np.abs(away - landmarks.distances_m[ids]) < 1e-2)
        )
    assert found.mean() > 0.99


def test_normals_point_to_the_observers(mapped):
    content = mapped.visual_map
    normals = content.landmarks.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    seen = content.observations
    rays = content.keyframes.positions_m[seen.keyframe_index] - content.landmarks.points_m[seen.landmark_index]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cosines = (rays * normals[seen.landmark_index]).sum(axis=1)
    assert np.median(cosines) > 0.98
    assert cosines.min() > 0.0


def test_s_places_the_free_scale_frame(mapped):
    """Its scale is the metres of one vis unit: the first map's median depth of ten units spans real metres."""
    S = mapped.visual_map.map_from_vis
    assert 0.1 < S.scale < 10.0
    np.testing.assert_allclose(S.rotation @ S.rotation.T, np.eye(3), atol=1e-9)
    first_camera = S.transform(np.zeros(3))  # the first keyframe is vis' origin
    np.testing.assert_allclose(first_camera, mapped.visual_map.keyframes.positions_m[0], atol=1.0)
