"""The package's nodes as separate processes in a private domain, and what they use."""
from __future__ import annotations

import ctypes
import fcntl
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from sphstereo_ros.replay.records import BadInput

STAGES = ('frame_pairing', 'pose_stabilisation', 'motion_alignment', 'spherical_stereo')
CHAINS = {'separate': STAGES, 'pipeline': ('pipeline',)}
PATIENCE = 10.0  # seconds for a process to end by itself
_PR_SET_PDEATHSIG = 1
_SHARED_MEMORY = Path('/dev/shm')


def private_domain() -> dict[str, str]:
    """Set a random domain on this machine alone, for this process and those it starts."""
    chosen = {'ROS_DOMAIN_ID': str(random.randint(1, 101)),
              'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    os.environ.update(chosen)
    return chosen


def command(name: str) -> str:
    """Path of an installed command of this package: of this environment, of ROS, or on PATH.

    Raises
    ------
    BadInput
        where it is not installed

    """
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    for path in (Path(sys.executable).with_name(name),
                 *(Path(p, 'lib', 'sphstereo_ros', name) for p in prefixes if p)):
        if path.is_file():
            return str(path)
    found = shutil.which(name)
    if found is None:
        raise BadInput(f'the command {name} is not installed')
    return found


def shipped(name: str) -> Path:
    """A file of the package's share folder (config/live.yaml), or of the source tree.

    Raises
    ------
    BadInput
        where there is none

    """
    prefixes = [sys.prefix, *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    candidates = [Path(__file__).parents[2] / name,
                  *(Path(p, 'share', 'sphstereo_ros', name) for p in prefixes if p)]
    for path in candidates:
        if path.exists():
            return path
    raise BadInput(f'{name} is not installed')


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Process:
    """A process that writes to a log, and what it uses of the machine."""

    def __init__(self, name: str, words: Sequence[str], log: Path) -> None:
        self.name = name
        self.log = log
        self.started = time.monotonic()
        with log.open('ab') as file:
            # A session of its own: Ctrl-C is for us alone, who end the rest in order.
            self._popen = subprocess.Popen(
                list(words), stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                start_new_session=True, preexec_fn=_end_with_parent)

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._popen.poll()

    def send(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self.status is None:
            self._popen.send_signal(number)

    def wait(self, timeout: float) -> int | None:
        """Exit status, None if it still runs after `timeout` seconds."""
        try:
            return self._popen.wait(timeout)
        except subprocess.TimeoutExpired:
            return None

    def usage(self) -> tuple[float, float]:
        """(resident memory in MB, seconds of CPU so far); NaN where the system does not tell."""
        try:
            pages = int(Path(f'/proc/{self._popen.pid}/statm').read_text().split()[1])
            fields = Path(f'/proc/{self._popen.pid}/stat').read_text().rpartition(')')[2].split()
        except (OSError, IndexError):
            return float('nan'), float('nan')
        ticks = int(fields[11]) + int(fields[12])
        return (pages * os.sysconf('SC_PAGE_SIZE') / 1e6, ticks / os.sysconf('SC_CLK_TCK'))


class Processes:
    """Starts processes; leaving the context ends all of them, whatever happened."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._logs.mkdir(parents=True, exist_ok=True)
        self._segments = _abandoned_segments()
        self.running: dict[str, Process] = {}

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        # A second Ctrl-C must not leave half of them behind.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self.stop(*self.running)
            self._remove_segments()
        finally:
            signal.signal(signal.SIGINT, before)

    def start(self, name: str, *words: str) -> Process:
        """Start the command `name` of this package, or `words` as they are for another."""
        line = list(words) if words and Path(words[0]).is_absolute() else [command(name), *words]
        process = Process(name, line, self._logs / f'{name}.log')
        self.running[name] = process
        return process

    def start_chain(self, chain: str, parameters: Sequence[str]) -> None:
        """Start the nodes of a chain (`CHAINS`) with ROS arguments."""
        for node in CHAINS[chain]:
            self.start(node, *(['--ros-args', *parameters] if parameters else []))

    def stop(self, *names: str) -> dict[str, int]:
        """End processes by SIGINT, by SIGKILL if need be; returns exit statuses by name."""
        ending = {name: self.running.pop(name) for name in names}
        for process in ending.values():
            process.send(signal.SIGINT)
        statuses = {}
        deadline = time.monotonic() + PATIENCE
        for name, process in ending.items():
            status = process.wait(max(0.1, deadline - time.monotonic()))
            if status is None:
                process.send(signal.SIGKILL)
                status = process.wait(PATIENCE)
            statuses[name] = -signal.SIGKILL if status is None else status
        return statuses

    def kill(self, name: str) -> None:
        """End a process without any warning."""
        process = self.running.pop(name)
        process.send(signal.SIGKILL)
        process.wait(PATIENCE)

    def ended(self) -> Process | None:
        """A process that is expected to run but has ended."""
        return next((p for p in self.running.values() if p.status is not None), None)

    def _remove_segments(self) -> None:
        for path in _abandoned_segments() - self._segments:
            path.unlink(missing_ok=True)
            path.with_name(f'{path.name}_el').unlink(missing_ok=True)


def _abandoned_segments() -> set[Path]:
    """Shared memory of Fast DDS whose owner was killed: nobody holds its lock."""
    found = set()
    for lock in _SHARED_MEMORY.glob('fastrtps_*_el'):
        segment = lock.with_name(lock.name.removesuffix('_el'))
        if '_port' in segment.name or not segment.exists():
            continue
        try:
            with lock.open('rb') as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # in use, or another user's
            continue
        found.add(segment)
    return found


def numbers(values: Sequence[float], places: int = 1) -> dict[str, Any]:
    """Median and 95th percentile, None without values."""
    ordered = sorted(values)
    if not ordered:
        return {'p50': None, 'p95': None}

    def at(share: float) -> float:
        return round(ordered[min(int(share * len(ordered)), len(ordered) - 1)], places)
    return {'p50': at(0.5), 'p95': at(0.95)}
