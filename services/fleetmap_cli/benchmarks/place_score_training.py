"""Learns how the evidence for a place is to be weighed: PLACE_WEIGHTS of fleetmap_localizer.likeness.

Use it as ``python -m fleetmap_cli.benchmarks.place_score_training``; it takes a quarter of an hour on two cores.
Second vehicles are asked for their pose in the map of their own street, and in that of a street of the same shape,
a quarter of whose surfaces is the same. None of these streets is in a benchmark. Printed are the weights, and how
many poses would be believed at which score, of streets that the weights were not learned from; then the same for
maps that do not tell their descriptors' orientations, as those before format 2.1.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.camera import Camera
from fleetmap.drive import Frame
from fleetmap.geometry import Pose
from fleetmap.simulation.parallel import usable_cores
from fleetmap.vision.features import FeatureExtractor
from fleetmap_cli.benchmarks.simulated_draws import STREETS, Draw
from fleetmap_localizer.likeness import place_evidence
from fleetmap_localizer.map_view import LocalizableMap, MapView
from fleetmap_localizer.query_image import QueryImage
from fleetmap_localizer.relocalization import find_candidates
from fleetmap_localizer.settings import LocalizerSettings

Array = NDArray[np.float64]

_FIRST_DRAW = 2000
_KINDS = (*STREETS, "open")
_QUERY_RATE_HZ = 4.0
_RIGHT_M, _WRONG_M = 1.0, 5.0  # between them it may be the map that is wrong
_RIDGE = 1.0  # on weights of standardised evidence


@dataclass(frozen=True)
class Example:
    """The likeliest pose of one image."""

    draw: int
    evidence: Array  # (3,) see fleetmap_localizer.likeness.place_evidence
    is_right: bool
    is_oriented: bool = True  # see fleetmap_localizer.likeness.Likeness


def examples_of(draw: Draw) -> list[Example]:
    """Of the images of one street, and of its twin's where there is one, in its map."""
    source = draw.mapped()
    landmarks = replace(source.content.landmarks, angles_deg=None)
    sources = (source, replace(source, content=replace(source.content, landmarks=landmarks)))
    variants = (draw, replace(draw, variant=1)) if draw.has_twin else (draw,)
    images = [(each, list(each.images(_QUERY_RATE_HZ))) for each in variants]
    return [example for each, seen in images for source in sources for example in _examples(each, source, seen)]


def _examples(
    draw: Draw, source: LocalizableMap, images: Iterable[tuple[Camera, Frame, Pose]]
) -> Iterator[Example]:
    settings = LocalizerSettings()
    camera = draw.query().camera
    views, extractor = [MapView(source, camera, settings)], FeatureExtractor(camera, settings.features)
    for _, frame, utm_from_cam in images:
        found = find_candidates(views, camera, QueryImage.of(frame, extractor), settings)
        if not found:
            continue
        best = max(found, key=lambda each: each.support)  # not by score: weights are what is to be learned
        away_m = float(np.linalg.norm(best.utm_from_cam().translation_m - utm_from_cam.translation_m))
        if draw.variant or not _RIGHT_M < away_m < _WRONG_M:
            evidence, is_right = place_evidence(best.likeness), draw.variant == 0 and away_m <= _RIGHT_M
            yield Example(draw.number, evidence, is_right, best.likeness.is_oriented)


def learn(evidence: Array, is_right: NDArray[np.bool_]) -> Array:
    """Weights (3,) of a logistic regression; right and wrong examples count as much, however many there are.

    Source: Newton's method, as in C. Bishop, "Pattern recognition and machine learning", 2006, section 4.3.3.
    """
    mean, spread = evidence[:, :-1].mean(axis=0), evidence[:, :-1].std(axis=0)
    standard = np.column_stack([(evidence[:, :-1] - mean) / spread, np.ones(len(evidence))])
    importance = np.where(is_right, 0.5 / is_right.mean(), 0.5 / (1.0 - is_right.mean()))
    ridge = np.diag([_RIDGE] * len(mean) + [1e-6])
    weights = np.zeros(standard.shape[1])
    for _ in range(30):
        probability = 1.0 / (1.0 + np.exp(-standard @ weights))
        gradient = standard.T @ (importance * (probability - is_right)) + ridge @ weights
        curvature = (standard.T * (importance * probability * (1.0 - probability))) @ standard + ridge
        weights -= np.linalg.solve(curvature, gradient)
    scaled = weights[:-1] / spread
    return np.append(scaled, weights[-1] - scaled @ mean)


def scores_of_others(examples: list[Example]) -> Array:
    """Each example's score, by weights learned from the other streets."""
    evidence, is_right, draws = _columns(examples)
    scores = np.empty(len(examples))
    for draw in np.unique(draws):
        mine = draws == draw
        scores[mine] = evidence[mine] @ learn(evidence[~mine], is_right[~mine])
    return scores


def _columns(examples: list[Example]) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    return (
        np.array([each.evidence for each in examples]),
        np.array([each.is_right for each in examples]),
        np.array([each.draw for each in examples]),
    )


def report(examples: list[Example]) -> str:
    """Weights, and what the scores of other streets tell apart."""
    evidence, is_right, _ = _columns(examples)
    scores = scores_of_others(examples)
    lines = [f"{learn(evidence, is_right).round(2).tolist()}"]
    lines.append(f"{np.count_nonzero(is_right)} right, {np.count_nonzero(~is_right)} wrong")
    for least in np.arange(-2.0, 6.1, 0.5):
        right, wrong = (100.0 * np.mean(scores[which] >= least) for which in (is_right, ~is_right))
        lines.append(
            f"score >= {least:4.1f}: {right:5.1f} % of the right, {wrong:5.1f} % of the wrong are believed"
        )
    return "\n".join(lines)


def _main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--streets", type=int, default=120)
    count = parser.parse_args().streets
    draws = [Draw(_FIRST_DRAW + number, _KINDS[number % len(_KINDS)]) for number in range(count)]
    with ProcessPoolExecutor(usable_cores(), mp_context=multiprocessing.get_context("spawn")) as executor:
        drawn = [example for examples in executor.map(examples_of, draws) for example in examples]
    for title, is_oriented in (("PLACE_WEIGHTS", True), ("PLACE_WEIGHTS_UNORIENTED", False)):
        print(f"{title}: {report([each for each in drawn if each.is_oriented == is_oriented])}")


if __name__ == "__main__":
    _main()
