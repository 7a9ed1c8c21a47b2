"""Chunks of a map made on many machines, by Dask (extra `dask`): a chunk is a task.

Workers open the recordings themselves, by the same absolute path: on several machines that is a
shared folder.
"""
from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from sphstereo_ros.core.config import Config
from sphstereo_ros.replay.map_chunks import Division, Recording, chunks_of
from sphstereo_ros.replay.map_run import MapRun
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.sources import open_source
from sphstereo_ros.replay.submap_files import Chunk

_LOCAL = 'local:'


@contextmanager
def cluster(address: str) -> Iterator[Any]:
    """A client of the scheduler at `address`; `local:N` starts N processes on this machine, that
    nothing outside it can reach.

    Raises
    ------
    BadInput
        where there is none, or no Dask

    """
    try:
        distributed: Any = import_module('distributed')
    except ImportError as error:
        raise BadInput(f"--dask needs {error.name}: the extra 'dask' brings it") from error
    if not address.startswith(_LOCAL):
        try:
            client = distributed.Client(address, timeout='20s')
        except (OSError, ValueError) as error:
            raise BadInput(f'--dask: no scheduler at {address}: {error}') from error
        with client:
            yield client
        return
    try:
        count = int(address[len(_LOCAL):])
    except ValueError:
        count = 0
    if count < 1:
        raise BadInput(f'--dask: {address} is not local:N')
    with distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, host='127.0.0.1',
            dashboard_address=None, memory_limit=0,
            silence_logs=logging.ERROR) as local, distributed.Client(local) as client:
        yield client


def process(run: MapRun, client: Any, advance: Callable[[int], object]) -> None:
    """Make the chunks that are not there yet; `advance` is told the frames of each.

    What recordings did not tell of, when asked how long they are, is left to `MapRun.process`.

    Raises
    ------
    BadInput
        where a worker cannot read a recording, a task fails, or a chunk cannot be written

    """
    tasks = {}
    for n, chunk, frames in run.counted():
        if not run.path(n, chunk).exists():
            recording = run.recordings[n]
            task = client.submit(_chunk, recording.path.resolve(), recording.topic, recording.fps,
                                 run.config, run.division, chunk, pure=False)
            tasks[task] = n, chunk, frames
    if not tasks:
        return
    for task in import_module('distributed').as_completed(list(tasks)):
        n, chunk, frames = tasks.pop(task)
        try:
            done = task.result()
        except BadInput:
            raise
        except Exception as error:  # a worker that died, or another version of this package
            raise BadInput(f'--dask: chunk {chunk} of {run.recordings[n].path} failed: '
                           f'{type(error).__name__}: {error}') from error
        if done is not None:
            run.keep(n, chunk, done)
        task.release()
        advance(frames)


def _chunk(path: Path, topic: str, fps: float, config: Config, division: Division,
           number: int) -> Chunk | None:
    """One chunk, or None where the recording has less than it told."""
    recording = Recording(path, open_source(path, fps), topic, fps)
    for _, done in chunks_of(recording, config, division, lambda k: k == number):
        return done
    return None
