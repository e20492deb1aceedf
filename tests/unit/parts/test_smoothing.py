"""One smooth labelling: neighbors help each other, colors part them, and posteriors are probabilities."""

import numpy as np

from aomgen.parts.smoothing import smooth_posterior

GRID = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0.0], indexing="ij"), -1).reshape(-1, 3) * 0.005
LEFT = GRID[:, 0] < 0.05
GRAY = np.full((len(GRID), 3), 0.5)


def test_points_without_evidence_take_the_label_around_them():
    evidence = np.where(LEFT[:, None], [2.0, 0.0], [0.0, 2.0])
    unknown = np.random.default_rng(0).random(len(GRID)) < 0.5
    evidence[unknown] = 0.0
    found = np.argmax(smooth_posterior(GRID, GRAY, evidence), 1)
    assert np.mean(found == np.where(LEFT, 0, 1)) > 0.95


def test_single_points_that_err_are_outvoted_and_sure_ones_are_not():
    evidence = np.tile([1.0, 0.0], (len(GRID), 1))
    evidence[210] = [0.0, 0.5]
    evidence[50] = [0.0, 20.0]
    found = np.argmax(smooth_posterior(GRID, GRAY, evidence), 1)
    assert found[210] == 0
    assert found[50] == 1


def test_an_edge_in_color_parts_labels():
    """Evidence at two columns only: with an edge in color between, labels end there."""
    evidence = np.zeros((len(GRID), 2))
    evidence[GRID[:, 0] < 0.052] = [6.0, 0.0]
    evidence[GRID[:, 0] > 0.083] = [0.0, 6.0]
    edge = np.where((GRID[:, 0] < 0.067)[:, None], 0.1, 0.9) * np.ones(3)
    found = np.argmax(smooth_posterior(GRID, edge, evidence), 1)
    assert np.mean(found == np.where(GRID[:, 0] < 0.067, 0, 1)) > 0.95


def test_posteriors_are_probabilities_whatever_the_order_of_points():
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(len(GRID), 3))
    posterior = smooth_posterior(GRID + rng.normal(0, 1e-4, GRID.shape), GRAY, evidence)
    assert np.allclose(posterior.sum(1), 1)
    points = GRID + rng.normal(0, 1e-4, GRID.shape)
    order = rng.permutation(len(GRID))
    first, second = (smooth_posterior(points[k], GRAY, evidence[k]) for k in (np.arange(len(GRID)), order))
    assert np.allclose(first[order], second)


def test_one_point_has_no_neighbors():
    assert np.argmax(smooth_posterior(np.zeros((1, 3)), np.zeros((1, 3)), np.array([[0.0, 1.0]]))) == 1
