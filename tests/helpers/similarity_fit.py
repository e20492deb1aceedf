"""Similarity between two point sets with known correspondences."""

import numpy as np
import pycolmap


def best_similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the least-squares similarity S (4, 4) with `target ~ S(source)`, points (N, 3)."""
    found = pycolmap.estimate_sim3d(source, target)
    assert found is not None, "the points lie on a line"
    return np.vstack([found.matrix(), [0, 0, 0, 1]])
