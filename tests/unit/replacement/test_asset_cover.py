"""Discs of an asset that is not fitted to images: they face outward and know where light does not reach."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.procedural.shapes import Material, box, boxes_mesh
from aomgen.core.light import open_transfer
from aomgen.replacement import asset_cover
from aomgen.replacement.asset_cover import cover_asset


def test_discs_face_outward_and_know_what_is_in_their_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a block whose mesh is wound inside out, behind a closed door."""
    monkeypatch.setattr(asset_cover, "DISCS", 1200)
    monkeypatch.setattr(asset_cover, "COARSE", 300)
    asset = make_asset("microwave", 1)
    low, high = asset.static.bounds
    mesh = boxes_mesh("block", [box(low[0], high[0], -0.15, high[1], 0.0, high[2])], Material())
    mesh = replace(mesh, faces=mesh.faces[:, ::-1], uvs=mesh.uvs[:, ::-1])
    blocked = replace(asset, static=replace(asset.static, meshes=(mesh,)))
    (static, moving), coarse = cover_asset(blocked, np.random.default_rng(0))
    assert len(static.gaussians) > 2 * len(coarse[0].gaussians)
    assert len(moving.gaussians) > 2 * len(coarse[1].gaussians)
    middle = np.array([0, (high[1] - 0.15) / 2, high[2] / 2])
    assert (((static.gaussians.means - middle) * static.normals).sum(1) > 0).mean() > 0.95
    share = static.transfer[:, 0] / open_transfer(static.normals)[:, 0]
    front, top = (static.normals @ direction > 0.9 for direction in ([0, -1, 0], [0, 0, 1]))
    assert share[front].mean() < 0.9 * share[top].mean()
