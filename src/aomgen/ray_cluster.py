"""Executor of units of work with the workers of a Ray cluster."""

import importlib
import importlib.util
import socket
import subprocess
import sys
import time
from typing import Any, Final, Self

from aomgen.errors import BackendError
from aomgen.executors import RETRIES, Done, Opener, Work

# Time limit for a connection to the head of a cluster or to another server, [s].
CONNECT_S: Final = 5.0
RAY_PROBE: Final = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False, configure_logging=False)"
# Time limit for importing Ray and joining the cluster, which is sufficient on a busy machine, [s].
RAY_PROBE_S: Final = 60.0


class RayCluster:
    """Executor with the workers of a Ray cluster, which must have access to the folders or the store that the work uses.

    If the cluster has GPUs, each worker uses one.

    Args:
        opener: Function that each worker calls once.
        address: Address of the cluster, as for `ray.init`: "auto", "host:port", or "local" to start one on this machine.
        timeout_s: Time limit of a unit, [s].

    Raises:
        BackendError: Ray is not installed, or the cluster does not respond.
    """

    def __init__(self, opener: Opener, address: str, timeout_s: float) -> None:
        require_cluster(address)
        self._ray = ray = importlib.import_module("ray")
        ray.init(address=address, log_to_driver=False, configure_logging=False)
        there = ray.cluster_resources()
        gpus = int(there.get("GPU", 0))
        self.slots = gpus or max(int(there.get("CPU", 1)), 1)
        self._timeout_s, self._began = timeout_s, dict[Any, tuple[Any, float]]()
        self._opener = ray.put(opener)
        # Ray sets the number of threads of a task to its number of CPUs, which is one.
        self._do = ray.remote(max_retries=RETRIES, num_cpus=1, num_gpus=1 if gpus else 0)(_do_on_ray)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._ray.shutdown()

    def submit(self, unit: Any) -> None:
        """Start the execution of a unit as a separate task."""
        self._began[self._do.remote(self._opener, self._opener.hex(), unit)] = (unit, time.monotonic())

    def next_done(self) -> Done:
        """Wait until a unit has ended or exceeded the time limit, and return its result, or raise the error of its work.

        Ray executes the unit of a dead worker again.
        """
        errors = self._ray.exceptions
        while True:
            oldest = min(began for _, began in self._began.values())
            left_s = self._timeout_s - (time.monotonic() - oldest)
            ready, _ = self._ray.wait(list(self._began), timeout=max(left_s, 0.01))
            for task in ready:
                unit, _ = self._began.pop(task)
                try:
                    return Done(unit=unit, value=self._ray.get(task, timeout=self._timeout_s))
                except errors.RayTaskError as error:
                    raise error.cause or error from error
                except errors.RayError:
                    return Done(unit=unit, lost="worker_died")
            for task, (unit, began) in list(self._began.items()):
                if time.monotonic() - began > self._timeout_s:
                    self._ray.cancel(task, force=True)
                    del self._began[task]
                    return Done(unit=unit, lost="timeout")


def require_cluster(address: str) -> None:
    """Check that a Ray cluster responds; for its address, see `RayCluster`.

    Raises:
        BackendError: Ray is not installed, or the cluster does not respond.
    """
    if importlib.util.find_spec("ray") is None:
        raise BackendError("ray", "is not installed", "pip install 'aomgen[ray]'")
    problem = "" if address == "local" else _cluster_problem(address)
    if problem:
        raise BackendError(
            f"--ray {address}", f"no Ray cluster replies ({problem})", "start one with `ray start --head`"
        )


def _cluster_problem(address: str) -> str:
    """Describe why a cluster cannot be used; empty if it can. A child process connects, because Ray has no time limit."""
    host, colon, port = address.rpartition(":")
    try:
        if colon and port.isdigit():
            socket.create_connection((host.removeprefix("ray://"), int(port)), CONNECT_S).close()
        done = subprocess.run(
            [sys.executable, "-c", RAY_PROBE, address], capture_output=True, text=True, timeout=RAY_PROBE_S
        )
    except (OSError, OverflowError) as error:
        return str(error)
    except subprocess.TimeoutExpired:
        return f"nothing said within {RAY_PROBE_S:g} s"
    return (done.stderr.strip().splitlines() or ["no reason"])[-1] if done.returncode else ""


# Work that this process of a Ray cluster has opened, by the key of its opener; it holds at most one entry.
_OPENED: dict[str, Work] = {}


def _do_on_ray(opener: Opener, key: str, unit: Any) -> Any:
    if key not in _OPENED:
        _OPENED.clear()
        _OPENED[key] = opener()
    return _OPENED[key](unit)
