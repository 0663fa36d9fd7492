"""Covariances as bytes: never smaller than they were, and covariances still."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap.covariance_bytes import covariances_from_bytes, covariances_to_bytes
from fleetmap.errors import MapPackageError


def some_covariances(count: int, rank: int) -> np.ndarray:
    """Sigmas from 1e-4 to 10 and more; of low rank they are known perfectly in some directions."""
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(count, 6, rank)) * 10.0 ** rng.uniform(-3, 1, (count, 6, 1)) + 1e-4
    return (factors @ factors.transpose(0, 2, 1)).astype(np.float32)


@pytest.mark.parametrize("rank", [1, 3, 6, 20])
def test_what_is_read_exceeds_what_was_written_in_every_direction_but_not_by_much(rank: int) -> None:
    written = some_covariances(200, rank).astype(np.float64)
    read = covariances_from_bytes(covariances_to_bytes(written.astype(np.float32)), "here").astype(np.float64)
    sigmas = np.sqrt(np.diagonal(written, axis1=1, axis2=2))
    by_sigma = (read - written) / sigmas[:, :, None] / sigmas[:, None, :]
    assert np.linalg.eigvalsh(by_sigma).min() > -1e-6
    ratios = np.sqrt(np.diagonal(read, axis1=1, axis2=2)) / sigmas
    assert ratios.min() > 1.0
    assert 1.05 < ratios.max() < 1.12
    assert np.linalg.eigvalsh(by_sigma).max() < 1.6


def test_an_unknown_covariance_is_unknown_again() -> None:
    covariances = some_covariances(5, 8)
    covariances[[0, 3], 2, 2] = np.nan
    read = covariances_from_bytes(covariances_to_bytes(covariances), "here")
    assert np.isnan(read).all(axis=(1, 2)).tolist() == [True, False, False, True, False]
    assert np.isfinite(read[[1, 2, 4]]).all()


def test_of_no_keyframes_there_are_no_bytes() -> None:
    stored = covariances_to_bytes(np.empty((0, 6, 6), np.float32))
    assert stored.shape == (21, 0)
    assert covariances_from_bytes(stored, "here").shape == (0, 6, 6)


def test_bytes_that_are_no_covariance_are_refused() -> None:
    stored = covariances_to_bytes(some_covariances(3, 8))
    stored[6:, 1] = [129, 127, 127, 127, 127, 129, 127, 127, 127, 129, 127, 127, 127, 127, 127]
    with pytest.raises(MapPackageError, match="here: the covariance of a keyframe is none"):
        covariances_from_bytes(stored, "here")
