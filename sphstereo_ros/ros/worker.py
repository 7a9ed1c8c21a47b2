"""A thread that works off jobs; of those that may be late it keeps only the newest."""
from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

Job = Callable[[], None]


class Worker:
    """Runs jobs one after the other in a thread of its own.

    name : of the thread
    on_superseded : called for each late job that a newer one replaced
    on_error : called with the exception of a job that failed; the worker goes on
    capacity : how many late-able jobs may wait
    """

    def __init__(self, name: str, on_superseded: Callable[[], None],
                 on_error: Callable[[Exception], None], capacity: int = 1) -> None:
        self._on_superseded = on_superseded
        self._on_error = on_error
        self._capacity = capacity
        self._jobs: deque[tuple[Job, bool]] = deque()
        self._changed = threading.Condition()
        self._stopped = self._busy = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Job) -> None:
        """Queue a job that always runs."""
        with self._changed:
            self._jobs.append((job, False))
            self._changed.notify_all()

    def put_newest(self, job: Job) -> None:
        """Queue a job that a newer one may replace before it has begun."""
        superseded = False
        with self._changed:
            late = [i for i, (_, replaceable) in enumerate(self._jobs) if replaceable]
            if len(late) >= self._capacity:
                del self._jobs[late[0]]
                superseded = True
            self._jobs.append((job, True))
            self._changed.notify_all()
        if superseded:
            self._on_superseded()

    def put_when_free(self, job: Job) -> None:
        """Wait until there is nothing to do here, then queue a job.

        What the caller has done so far is not thrown away, and does not grow old in a queue.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or not (self._jobs or self._busy))
            self._jobs.append((job, False))
            self._changed.notify_all()

    def stop(self, timeout: float = 5.0) -> None:
        """End the thread after the job that is running."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or bool(self._jobs))
                if self._stopped:
                    return
                job, _ = self._jobs.popleft()
                self._busy = True
            try:
                job()
            except Exception as error:
                self._on_error(error)
            with self._changed:
                self._busy = False
                self._changed.notify_all()
