"""Making the views that a shelf lacks: by processes here, or on a Dask cluster."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from functools import cache
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import DataError, HostError, RigError, UsageError
from spikerig.dataset.terminal import note
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.shelf import Shelf, dumps, fingerprint, write_whole
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import Taken, in_parallel

PATIENCE_S = 5  # for a scheduler and its first worker


def make_view(spec: SceneSpec, number: int) -> bytes:
    """One view, finished, as `shelf.dumps` writes it."""
    return dumps(take_view(spec, number))


def fill(spec: SceneSpec, shelf: Shelf, workers: int, done: Callable[[], None]) -> None:
    """Make the views a shelf lacks, by processes on this machine.

    Args:
        spec: the scene.
        shelf: of its views.
        workers: processes; 1 works in this one.
        done: called after each view.
    """
    lacking = shelf.missing(spec.orbit.views)
    for _ in in_parallel(_fill_one, (spec, shelf.folder, lacking), len(lacking), workers):
        done()


def _fill_one(job: tuple[SceneSpec, Path, list[int]], rank: int) -> None:
    spec, folder, lacking = job
    _follow_parent()
    write_whole(folder / f"{lacking[rank]:06d}.npz", make_view(spec, lacking[rank]))


@cache
def _follow_parent() -> None:
    """In a worker process: end when the process that started it is killed, rather than wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (connection.wait([parent.sentinel]), os._exit(1)), daemon=True).start()


def finished(spec: SceneSpec, shelf: Shelf) -> Iterator[Taken]:
    """All views of a full shelf in order; one that is damaged (a power cut) is made again."""
    for number in range(spec.orbit.views):
        try:
            yield shelf.get(number)
        except DataError as error:
            note(f"{error.what} and made again: {error.value}")
            write_whole(shelf.path(number), make_view(spec, number))
            yield shelf.get(number)


class Cluster:
    """A Dask cluster that makes views; use it in a `with`.

    Args:
        address: of its scheduler, as in tcp://host:8786.

    Attributes:
        made_by: the fingerprint of the workers that are used.

    Raises:
        UsageError: not an address.
        HostError: the extra is missing, nobody answers, there is no worker, or workers run other code.
    """

    def __init__(self, address: str) -> None:
        if "://" not in address:
            raise UsageError("not a scheduler's address", value=address, expected="as in tcp://127.0.0.1:8786")
        try:
            from distributed import Client
        except ImportError as error:
            raise HostError(
                "a Dask cluster needs an extra that is not installed",
                value=f"no module named {error.name}",
                next="pip install 'spikerig[cluster]', here and on the workers",
            ) from None
        try:
            self._client: Any = Client(address, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise HostError(
                "the Dask scheduler does not answer",
                value=f"{address} ({type(error).__name__} after {PATIENCE_S} s)",
                cause="it does not run, the address is another's, or a firewall is between",
                next="dask scheduler --port 8786, and on each machine: dask worker tcp://HOST:8786 --nthreads 1",
            ) from None
        try:
            self.made_by = self._choose(address)
        except BaseException:
            self._client.close()
            raise

    def _choose(self, address: str) -> dict[str, str]:
        """Workers that all give the same bits: those like this machine, else the most numerous kind."""
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE_S)
        except TimeoutError:
            raise HostError(
                "the Dask cluster has no workers", value=address, next=f"dask worker {address} --nthreads 1"
            ) from None
        try:
            kinds: dict[str, dict[str, str]] = self._client.run(fingerprint)
        except Exception as error:
            raise HostError(
                "the Dask workers cannot run this program",
                value=f"{type(error).__name__}: {error}",
                next="install the same spikerig on the workers",
            ) from error
        here = fingerprint()
        foreign = {w: k for w, k in kinds.items() if (k["spikerig"], k["code"]) != (here["spikerig"], here["code"])}
        if foreign:
            raise HostError(
                "Dask workers run another spikerig than this one",
                value=f"{len(foreign)} of {len(kinds)}, such as {next(iter(foreign))}",
                next="install the same version on all of them and start them again",
            )
        numbers = [list(kinds.values()).count(kind) for kind in kinds.values()]
        chosen = here if here in kinds.values() else list(kinds.values())[numbers.index(max(numbers))]
        self.workers = sorted(worker for worker, kind in kinds.items() if kind == chosen)
        if len(self.workers) < len(kinds):
            note(f"{len(kinds) - len(self.workers)} workers with another CPU or NumPy are left out: bits would differ")
        if chosen != here:
            note("the workers' CPU or NumPy is not this machine's: bytes will be those of the workers")
        return chosen

    def fill(self, spec: SceneSpec, shelf: Shelf, done: Callable[[], None]) -> None:
        """Make the views a shelf lacks on the cluster; they come back as bytes and are written here.

        Raises:
            HostError: the cluster went away, or a view killed its workers; what is finished stays on the shelf.
        """
        from distributed import as_completed

        lacking = iter(shelf.missing(spec.orbit.views))
        running: dict[Any, int] = {}
        threads = self._client.nthreads()
        ahead = 2 * sum(threads.get(worker, 1) for worker in self.workers)

        def start() -> Any:
            number = next(lacking, None)
            if number is None:
                return None
            # Never the result of an earlier run of the same name, and never on a worker of another kind.
            future = self._client.submit(make_view, spec, number, workers=self.workers, pure=False)
            running[future] = number
            return future

        try:
            first = [future for _ in range(ahead) if (future := start()) is not None]
            queue = as_completed(first, loop=self._client.loop)
            for future in queue:
                write_whole(shelf.path(running.pop(future)), future.result())
                future.release()
                done()
                following = start()
                if following is not None:
                    queue.add(following)
        except RigError:
            raise
        except Exception as error:
            raise HostError(
                "the Dask cluster failed",
                value=f"{type(error).__name__}: {error}",
                cause="the scheduler went away, or a view needs more memory than a worker has",
                next="run the same command again: finished views are kept",
            ) from error

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.close()
