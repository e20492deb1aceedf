"""One smooth labelling of points from the log-likelihoods of all evidence.

A conditional random field over nearest neighbors: neighbors of one color tend to be of one part. Mean-field
iterations give each point's posterior, which says how sure a label is, where a graph cut says nothing.
Source: Kraehenbuehl and Koltun, "Efficient Inference in Fully Connected CRFs", 2011, with sparse neighbors.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from aomgen.core.values import Array

# Neighbours of a Gaussian in the graph: those around it on a surface.
NEIGHBORS = 10
# Coupling of two touching neighbors of one color, log odds; and the share of it that is left across an edge
# in color.
COUPLING, ACROSS_EDGE = 0.6, 0.2
# Distance over which points are one surface, [m]; and over which colors are one, of 0..1.
REACH_M, COLOR_SD = 0.01, 0.08
# Mean-field iterations: labels can spread over as many neighbourhoods.
ITERATIONS = 30


def smooth_posterior(points: ArrayLike, colors: ArrayLike, log_likelihoods: Array) -> Array:
    """Probability (N, L) of each label at each point.

    Args:
        points: (N, 3), [m].
        colors: (N, 3), 0..1.
        log_likelihoods: (N, L), of all evidence about a point alone.
    """
    coupling = _coupling(np.asarray(points, np.float64), np.asarray(colors, np.float64))
    posterior = _normalize(log_likelihoods)
    for _ in range(ITERATIONS):
        posterior = _normalize(log_likelihoods + coupling @ posterior)
    return posterior


def _coupling(points: Array, colors: Array) -> csr_matrix:
    count = min(NEIGHBORS, len(points) - 1)
    if count < 1:
        return csr_matrix((len(points), len(points)))
    distances, nearest = cKDTree(points).query(points, k=count + 1)
    distances, nearest = distances[:, 1:], nearest[:, 1:]
    contrast = np.linalg.norm(colors[:, None] - colors[nearest], axis=2)
    alike = ACROSS_EDGE + (1 - ACROSS_EDGE) * np.exp(-0.5 * (contrast / COLOR_SD) ** 2)
    weights = COUPLING * alike * np.exp(-0.5 * (distances / REACH_M) ** 2)
    rows = np.repeat(np.arange(len(points)), count)
    one_way = csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=(len(points), len(points)))
    return csr_matrix((one_way + one_way.T) / 2)


def _normalize(log_weights: Array) -> Array:
    weights = np.exp(log_weights - log_weights.max(1, keepdims=True))
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float64)
