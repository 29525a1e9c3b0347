"""Making of events by the workers of a Dask cluster that the user has started, or on this machine's cores."""

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError, expecting, needing
from .folders import SetFolder
from .pool import threads_per_worker
from .writing import EventWriter, Written

_RETRIES = 3
"""Number of attempts that Dask makes again for an event whose worker died."""
_ANSWER_SECONDS = 30
"""Time that a cluster has to answer, s."""
_writers: dict[Path, EventWriter] = {}
"""The writer of this Dask worker's set, by the set's folder."""
_event_lock = threading.Lock()
"""Lock that is held while an event is made, since one event uses all threads of its Dask worker."""


def check_address(address: str) -> None:
    """Raise `InputError` for what cannot be the address of a scheduler: Dask would try for long to reach it."""
    with needing("mphdrr[dask]", "--dask"):
        from distributed.comm import resolve_address
    if address == "local":
        return
    try:
        port = resolve_address(address).rpartition(":")[2]  # asks for the host's address
        if port.lstrip("-").isdecimal() and not 0 < int(port) < 65536:
            raise ValueError(f"port {port}")
    except (OSError, ValueError) as error:
        raise InputError(f"--dask {address}: expected local, or an address such as tcp://host:8786 ({error})") from None


def make_in_cluster(target: SetFolder, numbers: Sequence[int], address: str, workers: int) -> Iterator[Written]:
    """Make events of a prepared set on a Dask cluster and yield them in order of completion.

    `address` is that of Dask's scheduler, whose workers see the set's folder under the same path, or ``"local"`` for
    `workers` processes on this machine. Dask makes the events of a worker that died again. `InputError` where Dask is
    missing, the cluster does not answer, or a worker raises it.
    """
    with needing("mphdrr[dask]", "--dask"):
        from distributed import Client, KilledWorker, LocalCluster, as_completed
    with contextlib.ExitStack() as stack:
        cluster_address: Any = address
        threads = None  # as many as the Dask worker has
        if address == "local":
            threads = threads_per_worker(workers)
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
            )
            cluster_address = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(cluster_address, timeout=_ANSWER_SECONDS, set_as_default=False))
        except (OSError, ValueError) as error:
            raise InputError(f"--dask {address}: no scheduler answers there ({error})") from None
        path = target.path
        options = {"retries": _RETRIES, "pure": False}
        futures = [client.submit(_write_event, path, n, threads, key=f"{path}-{n}", **options) for n in numbers]
        numbers_by_key = dict(zip((future.key for future in futures), numbers, strict=True))
        try:
            for future in as_completed(futures, loop=client.loop):
                message = f"event {numbers_by_key[future.key]}: its workers died again and again; see their logs"
                with expecting(message, KilledWorker):
                    written = future.result()
                yield Written(*written)
        finally:
            client.cancel(futures)


def _write_event(folder: Path, number: int, threads: int | None) -> tuple[Any, ...]:
    """Make and write an event in a Dask worker, which keeps the scanner and its rays for the next event."""
    from distributed import get_worker

    with _event_lock:
        if folder not in _writers:
            _writers.clear()
            _writers[folder] = EventWriter(folder, threads or get_worker().state.nthreads)
        return tuple(_writers[folder].write(number))
