"""Where chunks are worked on: processes of this machine, of several, or the calling one.

Dask distributed keeps the processes, gives each the next chunk, and gives a chunk whose process
ended to another. What it is asked to keep is bounded by the number of processes: whoever uses a
pool submits no more than it has `room` for.
"""

from __future__ import annotations

import logging
import os
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from rasnik.instrument import System

__all__ = ["Finished", "Here", "Pool", "PoolError", "cores", "dask_pool"]

_PATIENCE_S = 10.0  # until a scheduler is taken as not there
_LOOK_S = 2.0  # how often the number of processes is asked for
_ALLOWED_DEATHS = 1  # of processes that worked on a chunk, before it is cut in two
_CLUSTER = {
    "distributed.scheduler.allowed-failures": _ALLOWED_DEATHS,
    # One chunk at a time for each process: if it ends, it is known which chunk it was.
    "distributed.scheduler.worker-saturation": 1.0,
    # Rows are small, and gone as soon as they are written: there is nothing to spill.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    # By default memory goes back to the system after every image, and is asked for again: that
    # takes a fifth of the time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    # What processes watch in themselves is for a dashboard, which there is none of.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
}
_ONE_THREAD = dict.fromkeys(
    ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


class PoolError(RuntimeError):
    """The processes cannot be reached, or are gone; says what to do."""


@dataclass(frozen=True)
class Finished:
    """What became of something that was submitted.

    Attributes
    ----------
    ticket : int
    value : object
    died : bool
        The processes that worked on it ended, one after the other; there is no value.
    """

    ticket: int
    value: Any = None
    died: bool = False


class Pool(Protocol):
    """Processes that work."""

    @property
    def workers(self) -> int:
        """How many there are now."""

    def room(self) -> int:
        """How much more should be submitted now."""

    def submit(self, ticket: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Have a function called."""

    def finished(self, timeout_s: float) -> list[Finished]:
        """What has come out since the last call; waits for the first so long.

        Raises
        ------
        PoolError
            If the processes are gone.
        Exception
            Whatever a function raised.
        """


class Here:
    """The calling process, one thing after the other."""

    workers = 1

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, Callable[..., Any], tuple[Any, ...]]] = deque()

    def room(self) -> int:
        return 1 - len(self._waiting)

    def submit(self, ticket: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._waiting.append((ticket, function, arguments))

    def finished(self, timeout_s: float) -> list[Finished]:
        if not self._waiting:
            return []
        ticket, function, arguments = self._waiting.popleft()
        return [Finished(ticket, function(*arguments))]


class _Dask:
    """Workers of a Dask scheduler."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._futures: dict[int, Any] = {}
        self._done: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._threads, self._looked_s = 0, -_LOOK_S

    @property
    def workers(self) -> int:
        now_s = time.monotonic()
        if now_s - self._looked_s >= _LOOK_S:
            self._threads, self._looked_s = sum(self._client.nthreads().values()), now_s
        return self._threads

    def room(self) -> int:
        return 2 * self.workers - len(self._futures)  # one at work, one to follow

    def submit(self, ticket: int, function: Callable[..., Any], *arguments: Any) -> None:
        future = self._client.submit(function, *arguments, pure=False)
        self._futures[ticket] = future
        future.add_done_callback(lambda _: self._done.put(ticket))

    def finished(self, timeout_s: float) -> list[Finished]:
        try:
            tickets = [self._done.get(timeout=timeout_s)]
            while not self._done.empty():
                tickets.append(self._done.get())
        except queue.Empty:
            if self._client.status not in ("running", "connecting"):
                raise PoolError("the scheduler is gone; the same command goes on") from None
            return []
        return [self._outcome(ticket, self._futures.pop(ticket)) for ticket in tickets]

    def _outcome(self, ticket: int, future: Any) -> Finished:
        from distributed import KilledWorker

        if future.status == "finished":
            return Finished(ticket, future.result())
        if future.status != "error":
            raise PoolError("the scheduler has dropped the work; the same command goes on")
        error = future.exception()
        if isinstance(error, KilledWorker):
            return Finished(ticket, died=True)
        if isinstance(error, ImportError):
            raise PoolError(f"a worker lacks a package ({error}); install the same on all")
        raise error


@contextmanager
def dask_pool(
    workers: int | None = None, scheduler: str | None = None, system: System | None = None
) -> Iterator[Pool]:
    """Processes that Dask distributed looks after.

    Parameters
    ----------
    workers : int, optional
        Processes started on this machine, by default one for each core.
    scheduler : str, optional
        Address of a scheduler to use instead, as in ``tcp://host:8786``.
    system : System, optional
        Of images to come. Where the package has never run, it is compiled for them beforehand,
        once on each machine.

    Raises
    ------
    ImportError
        If Dask distributed is not installed.
    PoolError
        If no scheduler answers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise ImportError(
            'several processes need Dask; install it with: pip install "rasnik[archive]"'
        ) from None
    with ExitStack() as opened:
        if scheduler is None:
            _compile(system)
            opened.enter_context(dask.config.set(_CLUSTER))
            cluster = opened.enter_context(
                LocalCluster(
                    n_workers=workers or cores(),
                    threads_per_worker=1,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                    env=_ONE_THREAD,
                )
            )
            yield _Dask(opened.enter_context(Client(cluster)))
            return
        try:
            client = opened.enter_context(Client(scheduler, timeout=_PATIENCE_S))
        except (OSError, ValueError) as error:
            raise PoolError(
                f"no scheduler answers at {scheduler} ({error}); start one with: dask scheduler"
            ) from None
        _compile_everywhere(client, system)
        yield _Dask(client)


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _compile(system: System | None) -> None:
    """What the first start on a machine takes long for, before there are many processes."""
    from rasnik.imaging.simulate import simulate
    from rasnik.tracking import warm_up

    if system is not None and not warm_up.is_compiled():
        warm_up.prepare(simulate(system, (1000.0, 1000.0, 0.0), seed=0).frames[0], system)


def _compile_everywhere(client: Any, system: System | None) -> None:
    """The same in one process of each machine."""
    by_host = {address.rpartition(":")[0]: address for address in client.nthreads()}
    tasks = [
        client.submit(_compile, system, workers=[address], pure=False)
        for address in by_host.values()
    ]
    for task in tasks:
        task.exception()  # what is wrong with a worker shows with the first chunk
