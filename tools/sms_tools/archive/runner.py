"""Independent tasks on the cores of one machine, or on a Dask cluster; a task that fails is a row that says why.

A worker that dies takes no row with it: what it worked on is done again, alone, for it may have been the reason. What
kills its worker alone twice fails: it may not have begun before another one's worker died.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from sms_adapters.extras import installed
from sms_online.errors import InputError
from sms_tools.archive.rows import Row

# Work of a task: a module's own function, so that another process can import it.
Work = Callable[..., Row]
Tasks = Mapping[str, tuple[object, ...]]
KILLED = "its worker died, perhaps for want of memory"
# A scheduler that does not answer within this time is not there, s.
PATIENCE = 10.0


def finished(
    work: Work, tasks: Tasks, *, workers: int | None = None, scheduler: str | None = None
) -> Iterator[tuple[str, Row]]:
    """Key and row of each task as it is finished, in any order.

    work: called with the arguments of each task; what it raises becomes {"error": …}. workers: processes of this
    machine, one for each core by default. scheduler: address of a Dask scheduler, whose workers do it in their place.
    InputError where no scheduler answers, or Dask is not installed.
    """
    if scheduler is not None:
        return _on_cluster(work, tasks, scheduler)
    return _on_cores(work, tasks, workers or cores())


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def outcome(work: Work, arguments: tuple[object, ...]) -> Row:
    """The row of a task, or what went wrong with it in a line."""
    try:
        return work(*arguments)
    except InputError as error:
        return {"error": str(error)}
    except Exception as error:  # whatever it is, the other tasks go on
        return {"error": " ".join(f"{type(error).__name__}: {error}".split())}


def _on_cores(work: Work, tasks: Tasks, workers: int) -> Iterator[tuple[str, Row]]:
    waiting, suspects, killers = deque(tasks), deque[str](), set[str]()
    running: dict[Future[Row], str] = {}
    pool = _pool(work, workers)
    try:
        while waiting or suspects or running:
            # Suspects one by one; others only once none is left, so that whose worker dies is to blame.
            queue, room = (suspects, 1) if suspects else (waiting, workers)
            alone = bool(suspects)
            while queue and len(running) < room:
                key = queue.popleft()
                try:
                    running[pool.submit(outcome, work, tasks[key])] = key
                except BrokenProcessPool:  # a worker died between two tasks
                    queue.appendleft(key)
                    pool = _pool(work, workers)
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            broken = False
            for future in done:
                if isinstance(future.exception(), BrokenProcessPool):
                    broken = True
                else:
                    yield running.pop(future), future.result()
            if broken:
                pool.shutdown()
                pool = _pool(work, workers)
                if alone:
                    key = running.popitem()[1]
                    if key in killers:
                        yield key, {"error": KILLED}
                    else:
                        killers.add(key)
                        suspects.appendleft(key)
                # All that ran are broken with the pool, but for those that were finished just before.
                for future in list(running):
                    key = running.pop(future)
                    if future.exception() is None:
                        yield key, future.result()
                    else:
                        suspects.append(key)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _pool(work: Work, workers: int) -> ProcessPoolExecutor:
    # Not forked from this process, whose threads would be in an undefined state; a server that has imported what the
    # work needs makes a new worker at once.
    servers = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if servers else "spawn")
    if servers:
        context.set_forkserver_preload([work.__module__])
    return ProcessPoolExecutor(workers, context, _initialise)


def _initialise() -> None:
    """Ctrl-C, which reaches the workers too, ends them without a word; so does the end of the run itself."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, name="end with parent", daemon=True).start()


def _end_with_parent() -> None:
    """A worker holds both ends of its queue, so it would not notice that nobody writes there any more."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # of a worker
    parent.join()
    os._exit(1)


def _on_cluster(work: Work, tasks: Tasks, scheduler: str) -> Iterator[tuple[str, Row]]:
    dask = installed("distributed", "--scheduler", scheduler, "cluster")
    try:
        client = dask.Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError("--scheduler", scheduler, str(error) or "no answer", "a scheduler's address") from None
    with client:
        keys = {client.submit(outcome, work, arguments, pure=False): key for key, arguments in tasks.items()}
        for future in dask.as_completed(keys):
            if future.cancelled():
                raise InputError("--scheduler", scheduler, "it ended", "a scheduler that runs until the end")
            # The scheduler gives what a dead worker did to others, and gives up what has killed several.
            if future.status != "error":
                yield keys[future], future.result()
                continue
            found = future.exception()
            yield keys[future], {"error": KILLED if isinstance(found, dask.KilledWorker) else f"on its worker: {found}"}
