"""Events made by the workers of a Dask cluster, which the user has begun, or of this machine's cores."""

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError, expecting, needing
from .folders import SetFolder
from .pool import threads_each
from .writing import EventWriter, Written

_RETRIES = 3
_ANSWER_SECONDS = 30
"""How long a cluster may take to answer."""
_writers: dict[Path, EventWriter] = {}
_one_event = threading.Lock()
"""Held while an event is made: it takes all threads of its Dask worker."""


def in_cluster(target: SetFolder, numbers: Sequence[int], address: str, workers: int) -> Iterator[Written]:
    """Make events of a set that is prepared, as they come; Dask does again what a worker that died had under way.

    `address` is that of Dask's scheduler, whose workers see the set's folder under the same path, or ``"local"`` for
    `workers` processes of this machine. `InputError` where Dask is missing, the cluster does not answer or a worker refuses.
    """
    with needing("mphdrr[dask]", "--dask"):
        from distributed import Client, KilledWorker, LocalCluster, as_completed
    with contextlib.ExitStack() as stack:
        where: Any = address
        threads = None  # those of a worker of the cluster
        if address == "local":
            threads = threads_each(workers)
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
            )
            where = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(where, timeout=_ANSWER_SECONDS, set_as_default=False))
        except (OSError, ValueError) as error:
            raise InputError(f"--dask {address}: no scheduler answers there ({error})") from None
        path = target.path
        futures = [
            client.submit(_write, path, n, threads, key=f"{path}-{n}", retries=_RETRIES, pure=False) for n in numbers
        ]
        of = dict(zip((future.key for future in futures), numbers, strict=True))
        try:
            for future in as_completed(futures, loop=client.loop):
                refusal = f"event {of[future.key]}: its workers died again and again; see their logs"
                with expecting(refusal, KilledWorker):
                    written = future.result()
                yield Written(*written)
        finally:
            client.cancel(futures)


def _write(folder: Path, number: int, threads: int | None) -> tuple[Any, ...]:
    """What a Dask worker does; the scanner and its rays are kept for the next event."""
    from distributed import get_worker

    with _one_event:
        if folder not in _writers:
            _writers.clear()
            _writers[folder] = EventWriter(folder, threads or get_worker().state.nthreads)
        return tuple(_writers[folder].write(number))
