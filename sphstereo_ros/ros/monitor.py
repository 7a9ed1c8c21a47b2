"""What a stage tells of itself in /diagnostics: rates, latency, drops by cause."""
from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sphstereo_ros.core.frames import Drop
from sphstereo_ros.ros.conversions import Status

OK, WARN, ERROR = 0, 1, 2
# Counted like all drops, but as they should be: no reason to warn.
EXPECTED = frozenset({'first_frame', 'other_transport', 'rate_limit'})
STALL = 2.0


def memory() -> dict[str, str]:
    """Memory of this process: its own, and what it shares with others (messages under way)."""
    kilobytes: dict[str, float] = {}
    try:
        for line in Path('/proc/self/status').read_text().splitlines():
            if line.startswith('Rss'):
                name, number, *_ = line.split()
                kilobytes[name] = float(number)
    except (OSError, ValueError):
        return {}
    own = kilobytes.get('RssAnon:', 0.0) + kilobytes.get('RssFile:', 0.0)
    return {'memory_mb': f'{own * 1.024e-3:.1f}',
            'shared_memory_mb': f'{kilobytes.get("RssShmem:", 0.0) * 1.024e-3:.1f}'}


class Monitor:
    """Counts what comes into a stage and what leaves it; all threads may use it.

    name : the status' name
    clock : monotonic seconds
    on_new_cause : called at the first drop of each cause
    stall : seconds without input, or without output, that are a stall
    stall_level : of a status that tells a stall
    """

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic,
                 on_new_cause: Callable[[Drop], None] = lambda drop: None,
                 stall: float = STALL, stall_level: int = WARN) -> None:
        self.name = name
        self.clock = clock
        self.stall = stall
        self._stall_level = stall_level
        self._fault, self._fault_level = '', OK
        self._on_new_cause = on_new_cause
        self._lock = threading.Lock()
        self._drops: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._last_drop: Drop | None = None
        self._in = self._out = self._reported_in = self._reported_out = 0
        self._last_in = self._last_out = self._reported_at = clock()
        self._latencies: deque[float] = deque(maxlen=300)
        self._values: dict[str, object] = {}
        self._warning = ''

    def arrived(self) -> float:
        """Count an input; returns its time of arrival."""
        with self._lock:
            now = self.clock()
            if self._in == self._out == 0:
                self._last_out = now
            self._in += 1
            self._last_in = now
            return now

    def published(self, arrival: float, values: dict[str, object] | None = None) -> None:
        """Count an output of what came in at `arrival`, with what is worth telling of it."""
        with self._lock:
            self._last_out = self.clock()
            self._out += 1
            self._latencies.append(self._last_out - arrival)
            self._values.update(values or {})

    def idle(self) -> None:
        """Say that something came that nobody wants: no input and no output is no stall."""
        with self._lock:
            self._last_in = self._last_out = self.clock()

    def fault(self, text: str, level: int = ERROR) -> None:
        """Say what keeps this part from working, from now on; '' = nothing."""
        with self._lock:
            self._fault, self._fault_level = text, level

    def tell(self, values: dict[str, object], warning: str = '') -> None:
        """Say what is worth telling from now on; a warning, until it is taken back."""
        with self._lock:
            self._values.update(values)
            self._warning = warning

    def dropped(self, drop: Drop) -> None:
        """Count a drop."""
        with self._lock:
            new = drop.cause not in self._drops
            self._drops[drop.cause] += 1
            self._last_drop = drop
        if new:
            self._on_new_cause(drop)

    def count(self, cause: str) -> int:
        """How often `cause` has dropped something."""
        with self._lock:
            return self._drops[cause]

    def status(self) -> Status:
        """What happened since the last call, and totals."""
        with self._lock:
            now = self.clock()
            seconds = max(now - self._reported_at, 1e-3)
            recent = self._drops - self._reported
            level, message = self._judge(recent, now)
            values: dict[str, object] = {
                'frames_in': self._in, 'frames_out': self._out,
                'rate_in': f'{(self._in - self._reported_in) / seconds:.2f}',
                'rate_out': f'{(self._out - self._reported_out) / seconds:.2f}',
                **self._latency(), 'drops': self._drops.total(),
                **{f'drops.{cause}': n for cause, n in sorted(self._drops.items())},
                **memory(), **self._values}
            if self._last_drop is not None:
                values['last_drop'] = f'{self._last_drop.cause}: {self._last_drop.detail}'
            self._reported = self._drops.copy()
            self._reported_in, self._reported_out = self._in, self._out
            self._reported_at = now
        return Status(self.name, level, message, values)

    def _latency(self) -> dict[str, str]:
        if not self._latencies:
            return {}
        p50, p95 = np.percentile(np.array(self._latencies) * 1e3, [50, 95])
        return {'latency_p50_ms': f'{p50:.2f}', 'latency_p95_ms': f'{p95:.2f}'}

    def _judge(self, recent: Counter[str], now: float) -> tuple[int, str]:
        if recent['internal_error']:
            return ERROR, 'internal error'
        if self._fault:
            return self._fault_level, self._fault
        if self._in == 0:
            return OK, 'waiting for input'
        if now - self._last_in > self.stall:
            return self._stall_level, f'stalled: no input for {now - self._last_in:.1f} s'
        unexpected = [f'{n} {cause}' for cause, n in recent.most_common() if cause not in EXPECTED]
        silent = now - self._last_out
        if silent > self.stall:
            return self._stall_level, ', '.join([f'stalled: no output for {silent:.1f} s',
                                                 *unexpected])
        if self._warning:
            return WARN, ', '.join([self._warning, *unexpected])
        return (WARN, 'dropped: ' + ', '.join(unexpected)) if unexpected else (OK, 'running')
