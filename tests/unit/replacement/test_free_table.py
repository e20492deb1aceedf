"""Objects stand on the free part of a table, which ends at its edges and at what stands on it."""

import numpy as np

from aomgen.replacement.free_table import free_rectangle


def table(spacing=0.01):
    x, y = np.meshgrid(np.arange(-0.3, 0.9, spacing), np.arange(-0.5, 0.7, spacing))
    return np.stack([x.ravel(), y.ravel()], 1)


def test_growth_stops_at_the_table_edges():
    low, high = free_rectangle(table(), [0.1, 0.0], [0.4, 0.3])
    assert np.allclose(low, [-0.3, -0.5], atol=0.03)
    assert np.allclose(high, [0.9, 0.7], atol=0.03)


def test_growth_stops_at_another_object():
    xy = table()
    hidden = (xy[:, 0] > 0.6) & (xy[:, 0] < 0.75) & (xy[:, 1] > 0.0) & (xy[:, 1] < 0.2)
    low, high = free_rectangle(xy[~hidden], [0.1, 0.0], [0.4, 0.2])
    box = (xy[hidden] > low) & (xy[hidden] < high)
    assert not np.all(box, axis=1).any()


def test_the_hidden_surface_under_the_object_is_free():
    xy = table()
    under = np.all((xy > [0.1, 0.0]) & (xy < [0.4, 0.3]), axis=1)
    low, high = free_rectangle(xy[~under], [0.1, 0.0], [0.4, 0.3])
    assert np.all(high - low > 1.0)


def test_without_any_surface_nothing_grows():
    low, high = free_rectangle(np.zeros((0, 2)), [0.1, 0.0], [0.4, 0.3])
    assert np.allclose(high - low, [0.3, 0.3], atol=0.05)
