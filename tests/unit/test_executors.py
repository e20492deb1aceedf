"""Units are done wherever there are workers, whatever happens to these."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from aomgen import ray_cluster
from aomgen.errors import BackendError, StorageError
from aomgen.executors import Done, Executor, Processes
from aomgen.ray_cluster import RayCluster, require_cluster
from executor_work import open_work

HELPERS = Path(__file__).parents[1] / "helpers"


@pytest.fixture(scope="module")
def ray_here() -> Iterator[str]:
    """A cluster of two workers on this machine."""
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    path = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(HELPERS), path])
    yield "local"
    os.environ["PYTHONPATH"] = path


def results(executor: Executor, units: list[str]) -> dict[str, Done]:
    """Do units, never more at a time than there are slots."""
    found, waiting, running = {}, list(units), 0
    while waiting or running:
        while waiting and running < executor.slots:
            executor.submit(waiting.pop(0))
            running += 1
        done = executor.next_done()
        found[done.unit], running = done, running - 1
    return found


def begun(folder: Path, unit: str) -> int:
    return len((folder / unit).read_text().splitlines())


def test_every_unit_is_done_once_by_workers_that_are_kept(tmp_path):
    units = [f"unit-{k}" for k in range(9)]
    with Processes(partial(open_work, tmp_path), 2, 60) as executor:
        found = results(executor, units)
    assert {unit: done.value for unit, done in found.items()} == {unit: (unit, 1) for unit in units}
    assert all(begun(tmp_path, unit) == 1 for unit in units)
    assert 1 <= len(list(tmp_path.glob("opened-*"))) <= 2


def test_a_dead_workers_unit_is_done_again_and_given_up_in_the_end(tmp_path):
    with Processes(partial(open_work, tmp_path), 2, 60) as executor:
        found = results(executor, ["die2", "unit", "die9"])
    assert found["die2"].value == ("die2", 1)
    assert (found["die9"].lost, found["die9"].value) == ("worker_died", None)
    assert begun(tmp_path, "die9") == 3
    assert found["unit"].value == ("unit", 1)


def test_a_unit_that_hangs_is_given_up(tmp_path):
    with Processes(partial(open_work, tmp_path), 2, 3.0) as executor:
        start = time.monotonic()
        found = results(executor, ["hang", "unit"])
    assert (found["hang"].lost, found["unit"].value) == ("timeout", ("unit", 1))
    assert time.monotonic() - start < 8


def test_a_worker_that_died_beyond_the_time_limit_is_removed_once(tmp_path):
    with Processes(partial(open_work, tmp_path), 1, 0.01) as executor:
        executor.submit("die9")
        executor._workers[0].process.join()
        # The unit is started again, and this time the limit is noticed.
        assert executor.next_done().lost == "timeout"


def test_what_the_work_raises_arrives(tmp_path):
    with Processes(partial(open_work, tmp_path), 1, 60) as executor:
        with pytest.raises(StorageError, match="disk: is full; free space") as raised:
            results(executor, ["fail"])
        assert raised.value.exit_code == 6
    with Processes(partial(open_work, tmp_path), 1, 60) as executor, pytest.raises(ZeroDivisionError) as bug:
        results(executor, ["bug"])
    assert "executor_work.py" in bug.value.__notes__[0]


def test_workers_end_with_their_parent(tmp_path):
    script = (
        "import sys, time; from functools import partial; from pathlib import Path\n"
        f"sys.path.insert(0, {str(HELPERS)!r})\n"
        "from executor_work import open_work; from aomgen.executors import Processes\n"
        "if __name__ == '__main__':\n"
        f"    executor = Processes(partial(open_work, Path({str(tmp_path)!r})), 1, 60)\n"
        "    executor.submit('hang'); time.sleep(60)\n"
    )
    file = tmp_path / "parent.py"
    file.write_text(script)
    parent = subprocess.Popen([sys.executable, str(file)])
    deadline = time.monotonic() + 30
    while not (tmp_path / "hang").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    (opened,) = tmp_path.glob("opened-*")
    worker = int(opened.name.removeprefix("opened-"))
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


@pytest.mark.slow
def test_ray_does_the_same(tmp_path, ray_here):
    with RayCluster(partial(open_work, tmp_path), ray_here, 60) as executor:
        found = results(executor, ["unit", "die1", "die9"])
        assert found["unit"].value == ("unit", 1)
        assert found["die1"].value == ("die1", 1)
        assert found["die9"].lost == "worker_died"
        with pytest.raises(StorageError, match="disk: is full"):
            results(executor, ["fail"])


@pytest.mark.slow
def test_a_unit_that_hangs_on_ray_is_given_up(tmp_path, ray_here):
    # Workers of the cluster take seconds to start, more on a busy machine.
    with RayCluster(partial(open_work, tmp_path), ray_here, 20.0) as executor:
        start = time.monotonic()
        executor.submit("hang")
        assert executor.next_done().lost == "timeout"
        assert time.monotonic() - start < 25


def test_a_cluster_that_is_not_there_is_named():
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    for address in ("127.0.0.1:1", "127.0.0.1:99999"):
        with pytest.raises(BackendError, match=f"--ray {address}: no Ray cluster replies"):
            require_cluster(address)


def test_an_address_where_something_else_listens_is_named(monkeypatch):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    monkeypatch.setattr(ray_cluster, "RAY_PROBE_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(BackendError, match=r"no Ray cluster replies \(nothing said within 2 s\)"):
            require_cluster(address)
