"""Fits are counted over all categories, with a reason for each asset that is left out."""

from types import SimpleNamespace

import pytest

from aomgen.errors import EstimationError
from aomgen.replacement.correspondence import describe_contact
from benchmarks import grip_on_meshes, replace_fits
from recordings import gripped_recording


@pytest.fixture
def films(monkeypatch, robot):
    """Films of a microwave, of which that of seed 7 shows nothing."""
    demo, recorded = gripped_recording("microwave")
    contact = describe_contact(demo, recorded, "opening")
    shown = []

    def film(category, number, folder, kind):
        shown.append((category, number))
        return SimpleNamespace(demonstration=SimpleNamespace(number=number, robot=robot))

    def recover(given, direction):
        if given.number == 7:
            raise EstimationError("demonstration video", "shows nothing", "try another world")
        return demo, None, contact, 10.0

    monkeypatch.setattr(replace_fits, "motion_world", film)
    monkeypatch.setattr(replace_fits, "recorded_motion", recover)
    monkeypatch.setattr(replace_fits, "ASSETS", 2)
    monkeypatch.setattr(grip_on_meshes, "POSES", 2)
    return shown


@pytest.mark.slow
def test_a_video_without_motion_is_reported_and_the_next_one_is_used(films, monkeypatch, tmp_path):
    monkeypatch.setattr(replace_fits, "CATEGORIES", ("microwave", "drawer"))
    found = replace_fits.run_fits(tmp_path, 7, lambda text: None)
    microwaves, drawers = found["categories"]
    assert films == [("microwave", 7), ("microwave", 8), ("drawer", 7), ("drawer", 8)]
    assert microwaves["refused"] == ["microwave-7: demonstration video: shows nothing; try another world"]
    assert len(microwaves["contact_mm"]) == 2
    # Drawers do not move as a microwave's door does.
    assert drawers["contact_mm"] == []
    assert all(reason.startswith("joint_type: asset is prismatic") for reason in drawers["rejects"])
    assert found["accepted_share"] == 0.5
    assert found["contact_mm_worst"] == max(microwaves["contact_mm"])


def test_no_video_with_motion_is_an_error(films, monkeypatch, tmp_path):
    monkeypatch.setattr(replace_fits, "MAX_WORLDS", 1)
    with pytest.raises(EstimationError, match="shows nothing"):
        replace_fits.run_fits(tmp_path, 7, lambda text: None)
