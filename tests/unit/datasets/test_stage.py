from pathlib import Path
from types import SimpleNamespace

from aomgen.core.progress import silent
from aomgen.datasets.audit import audit_dataset
from aomgen.datasets.stage import run
from aomgen.io.episode_folder import list_committed
from aomgen.io.review import ReviewChange, change_review, leave_out_rejected
from aomgen.pipeline.stages import rejections_digest
from small_episodes import commit


def test_the_dataset_of_a_run_leaves_out_rejected_episodes(tmp_path: Path) -> None:
    episodes = tmp_path / "08_episodes"
    for index in range(3):
        commit(episodes, index, 9)
    results = SimpleNamespace(
        params=lambda stage, defaults: defaults, out=tmp_path, folders={"episodes": episodes}
    )
    assert run(results, tmp_path / "dataset", silent)["episodes"] == 3
    before = rejections_digest(tmp_path)
    change_review(tmp_path, episodes / "000000", ReviewChange(decision="accepted", note="fine"))
    # What a person accepts or notes does not change the dataset.
    assert rejections_digest(tmp_path) == before
    change_review(tmp_path, episodes / "000001", ReviewChange(decision="rejected"))
    assert rejections_digest(tmp_path) != before
    assert run(results, tmp_path / "dataset", silent) == {"episodes": 2, "frames": 18}
    kept = leave_out_rejected(tmp_path, list_committed(episodes))
    assert audit_dataset(tmp_path / "dataset", kept).faults == []
