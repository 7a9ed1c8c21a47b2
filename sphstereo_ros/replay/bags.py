"""Bags as sources: mcap and db3, a file or a folder, whole or broken."""
from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from sphstereo_ros.replay.records import BadInput, Record, Source

SUFFIXES = ('.mcap', '.db3')
_MAGIC = {b'\x89MCAP0\r\n': '.mcap', b'SQLite format 3\x00': '.db3'}
# A record longer than this is a damaged length.
_LONGEST_RECORD = 2**30


def bag_files(path: Path) -> list[Path]:
    """List the storage files of a bag (file or folder), in order; empty if it is no bag."""
    if path.is_dir():
        found = [p for p in path.iterdir() if p.suffix in SUFFIXES]
        # rosbag2 numbers its files NAME_0, NAME_1 … NAME_10.
        return sorted(found, key=lambda p: (len(p.name), p.name))
    return [path] if _kind(path) else []


def _kind(path: Path) -> str:
    with path.open('rb') as file:
        head = file.read(16)
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    return path.suffix if path.suffix in SUFFIXES else ''


def open_bag(path: Path) -> Source:
    """Open a bag; one whose index is broken is read as far as it goes.

    Raises
    ------
    BadInput
        where not one message can be read

    """
    files = bag_files(path)
    if files and not any(file.stat().st_size for file in files):
        raise BadInput(f'{path} is empty (0 bytes)')
    bag: Source
    try:
        bag = IndexedBag(path)
    except Exception as error:  # a damaged bag fails in many ways
        bag = SalvagedBag(files, f'{type(error).__name__}: {error}')
    if not bag.count(bag.topics):
        reason = f': {bag.problem}' if bag.problem else ''
        raise BadInput(f'{path} holds no readable message{reason}')
    return bag


class IndexedBag:
    """A bag whose index is whole."""

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        self._reader.open()
        self._connections = [c for c in self._reader.connections
                             if getattr(c.ext, 'serialization_format', '') == 'cdr']
        self.topics: Mapping[str, str] = {c.topic: c.msgtype for c in self._connections}
        self.problem = ''

    def count(self, topics: Collection[str]) -> int:
        """How many records of these topics there are."""
        return sum(c.msgcount for c in self._connections if c.topic in topics)

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Read the records of these topics in time order."""
        wanted = [c for c in self._connections if c.topic in topics]
        if not wanted:
            return
        done = 0
        try:
            for connection, time, data in self._reader.messages(wanted):
                yield Record(connection.topic, connection.msgtype, time, data)
                done += 1
        except Exception as error:  # a damaged bag fails in many ways
            self.problem = f'damaged after {done} messages ({_one_line(error)})'


class _DamageError(Exception):
    """The file cannot be read on."""


class SalvagedBag:
    """A bag that has no index: a recorder that died, a copy that was cut off."""

    def __init__(self, files: list[Path], reason: str) -> None:
        self._files = files
        self.topics: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self.problem = reason if not files else ''
        for record in self._all():
            self.topics[record.topic] = record.kind
            self._counts[record.topic] += 1

    def count(self, topics: Collection[str]) -> int:
        """How many records of these topics can be read."""
        return sum(self._counts[topic] for topic in topics)

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Read the records of these topics as they lie in the file, which is time order."""
        return (record for record in self._all() if record.topic in topics)

    def _all(self) -> Iterator[Record]:
        done = 0
        for file in self._files:
            read: Callable[[Path], Iterator[Record]]
            read = _read_db3 if _kind(file) == '.db3' else _read_mcap
            try:
                for record in read(file):
                    yield record
                    done += 1
            except _DamageError as error:
                self.problem = f'truncated after {done} messages ({file.name}: {error})'


def _one_line(error: BaseException) -> str:
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0][:120]


def _read_mcap(path: Path) -> Iterator[Record]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open('rb') as file:
        records = StreamReader(file, validate_crcs=True, record_size_limit=_LONGEST_RECORD).records
        while True:
            try:
                item = next(records, None)
            except Exception as error:  # a damaged file fails in many ways
                raise _DamageError(_one_line(error)) from error
            if item is None:
                return
            if isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif isinstance(item, Message):
                channel = channels.get(item.channel_id)
                schema = schemas.get(channel.schema_id) if channel else None
                if channel and schema and channel.message_encoding == 'cdr':
                    yield Record(channel.topic, schema.name, item.log_time, item.data)


def _read_db3(path: Path) -> Iterator[Record]:
    uri = path.resolve().as_uri() + '?immutable=1&mode=ro'
    try:
        with closing(sqlite3.connect(uri, uri=True)) as database:
            # Lets SQLite open a file that is shorter than its head says.
            database.execute('PRAGMA writable_schema=1')
            topics = {key: (str(name), str(kind)) for key, name, kind in
                      database.execute('SELECT id, name, type FROM topics')}
            for key, time, data in database.execute(
                    'SELECT topic_id, timestamp, data FROM messages'):
                if key in topics and isinstance(time, int) and isinstance(data, bytes):
                    yield Record(*topics[key], time, data)
    except sqlite3.Error as error:
        raise _DamageError(_one_line(error)) from error
