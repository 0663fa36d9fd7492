"""Symmetric block-tridiagonal matrices: ordering a graph into levels, and the diagonal blocks of the inverse.

Nodes at the same distance from a far end of the graph form a level; edges join nodes of one level or of two
neighbouring ones, so a matrix with the graph's sparsity is block tridiagonal (the level structure behind the
Cuthill-McKee ordering: George and Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981,
section 4.3). Along a drive a level holds as many keyframes as see landmarks in common, and the work grows with the
length of the drive.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
_SWEEPS = 3  # searches for a far end of the graph; more seldom find a farther one


@dataclass(frozen=True)
class Levels:
    """A graph's nodes in levels; those of one connected component follow each other."""

    level_of: Ints  # (K,) int64
    place_of: Ints  # (K,) int64 among the nodes of its level
    sizes: Ints  # (L,) int64 nodes
    component_of: Ints  # (L,) int64 ascending: the connected component of a level

    def components(self) -> Iterator[range]:
        """The levels of each connected component."""
        borders = np.searchsorted(self.component_of, np.arange(self.component_of[-1] + 2)).tolist()
        return (range(start, end) for start, end in itertools.pairwise(borders))


def levels_of(adjacency: csr_array) -> Levels:
    """Sort the nodes of an undirected graph (K, K) into levels."""
    count, component_of_node = connected_components(adjacency, directed=False)
    level_of = np.empty(adjacency.shape[0], np.int64)
    component_of: list[int] = []
    for component in range(count):
        first = len(component_of)
        distances, order = _distances_from_far_end(adjacency, int(np.argmax(component_of_node == component)))
        level_of[order] = first + distances
        component_of += [component] * (int(distances[-1]) + 1)
    sizes = np.bincount(level_of)
    by_level = np.argsort(level_of, kind="stable")
    place_of = np.empty_like(level_of)
    place_of[by_level] = np.arange(len(level_of)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return Levels(level_of, place_of, sizes, np.array(component_of, dtype=np.int64))


def _distances_from_far_end(adjacency: csr_array, start: int) -> tuple[Ints, Ints]:
    """Ascending distances (n,) in edges of the nodes (n,) that hang together with ``start``."""
    for _ in range(_SWEEPS):
        order, predecessors = breadth_first_order(adjacency, start, directed=False)
        start = int(order[-1])
    distances = np.zeros(adjacency.shape[0], np.int64)
    for node in order[1:].tolist():
        distances[node] = distances[predecessors[node]] + 1
    return distances[order], order.astype(np.int64)


def diagonal_of_inverse(diagonal: Sequence[Array], lower: Sequence[Array]) -> list[Array]:
    """Diagonal blocks of the inverse of a positive definite matrix, exactly.

    Block by block S_l = D_l - E_l-1 S_l-1^-1 E_l-1^T, then from the far end back
    G_l = S_l^-1 + S_l^-1 E_l^T G_l+1 E_l S_l^-1
    (Takahashi's recursion on blocks: Erisman and Tinney, "On computing certain elements of the inverse of a sparse
    matrix", 1975).

    Args:
        diagonal: L blocks D_l (n_l, n_l), of which the lower triangles are read.
        lower: L - 1 blocks E_l (n_l+1, n_l) below them.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    roots: list[Array] = []
    halves: list[Array] = []  # C_l^-1 E_l^T where C_l C_l^T = S_l
    for block, E in itertools.zip_longest(diagonal, lower):
        S = block - halves[-1].T @ halves[-1] if halves else block
        roots.append(cholesky(S, lower=True))
        if E is not None:
            halves.append(solve_triangular(roots[-1], E.T, lower=True))
    inverse = [_inverse_of(roots[-1])]
    for C, half in zip(reversed(roots[:-1]), reversed(halves), strict=True):
        gain = solve_triangular(C, half, lower=True, trans="T")
        inverse.append(_inverse_of(C) + gain @ inverse[-1] @ gain.T)
    return inverse[::-1]


def _inverse_of(C: Array) -> Array:
    return np.asarray(cho_solve((C, True), np.eye(len(C))))
