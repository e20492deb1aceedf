"""Who owns the engine's memory."""

import gc
import threading
import weakref

from aomgen.splatting import native


def test_a_thread_keeps_its_scratch_context_until_it_ends() -> None:
    """Any number of threads: no thread takes the memory of another that still runs."""
    count = 20
    ready, seen = threading.Barrier(count), []

    def work() -> None:
        first = native.scratch_context()
        ready.wait(30)  # all threads have theirs
        seen.append((weakref.ref(first), native.scratch_context() is first))

    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    gc.collect()
    assert [kept for _, kept in seen] == [True] * count
    assert [context() for context, _ in seen] == [None] * count
    assert native.scratch_context() is native.scratch_context()
