"""The benchmarks' figures as tables in Markdown."""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .scoring import BANDS

Summaries = Mapping[str, Mapping[str, Any]]
# A wall ahead is worth a table from this share of the sphere on, in percent.
_LEAST_AHEAD = 0.1


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns are as wide as their widest cell."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = [head, ['-' * width for width in widths], *rows]
    return '\n'.join('| ' + ' | '.join(cell.ljust(width) for cell, width in
                                       zip(line, widths, strict=True)) + ' |' for line in lines)


def _number(value: float | None) -> str:
    return '–' if value is None else f'{float(f"{value:.3g}"):g}'


def _cell(group: Mapping[str, Any], *names: str) -> str:
    return ' / '.join(_number(group.get(name)) for name in names)


def tables(summaries: Summaries) -> str:
    """All tables that the sequences have figures for."""
    scored = {name: s for name, s in summaries.items() if s['frames']}
    if not scored:
        return 'no frame was scored'
    return '\n\n'.join(f'{title}\n\n{table}' for title, table in _tables(scored))


def _tables(scored: Summaries) -> Iterator[tuple[str, str]]:
    bands = [f'{low:g}-{high:g}' for low, high in BANDS]
    yield ('Coverage / median error / over 10 % error, in %',
           markdown(['method', *(f'{b} m' for b in bands), 'danger', 'ghost', 'frames (dropped)'],
                    [[name, *(_cell(s[b], 'coverage', 'median', 'bad') for b in bands),
                      _number(s['danger']), _number(s['ghost']), _frames(s)]
                     for name, s in scored.items()]))
    yield ('Error within 1 sigma / 2 sigma, in % of the pixels (expected: 68 / 95)',
           markdown(['method', *(f'{b} m' for b in bands)],
                    [[name, *(_cell(s[b], 'within_1_sigma', 'within_2_sigma') for b in bands)]
                     for name, s in scored.items()]))
    yield ('Rotation / direction error in degrees, by frames back (references lost, in %)',
           markdown(['method', 'poses'], [[name, _poses(s)] for name, s in scored.items()]))
    yield ('By degrees from the direction of motion, at 20 m: coverage / median error, in %',
           _cone(scored))
    ahead = {name: s['ahead_at_40m'] for name, s in scored.items()}
    if any(sum(group['share'] or 0 for group in s.values()) > _LEAST_AHEAD
           for s in ahead.values()):
        yield ('Ahead at 40 m, by degrees: coverage / median error / unknown / too far, in %',
               markdown(['method', *(f'{step}°' for step in next(iter(ahead.values())))],
                        [[name, *(_cell(group, 'coverage', 'median', 'unknown', 'free')
                                  for group in s.values())] for name, s in ahead.items()]))
    yield from _moving(scored)


def _frames(summary: Mapping[str, Any]) -> str:
    causes = ', '.join(f'{n} {cause}' for cause, n in summary['drops'].items())
    return f'{summary["frames"]} ({causes or 0})'


def _poses(summary: Mapping[str, Any]) -> str:
    return '; '.join(
        f'{back}: {_number(r["rotation_deg"])} / {_number(r["direction_deg"])}'
        + (f' ({_number(r["lost"])} lost)' if r['lost'] else '')
        for back, r in summary['references'].items()) or '–'


def _cone(scored: Summaries) -> str:
    steps = list(next(iter(scored.values()))['cone']['ahead'])
    return markdown(['method', '', *(f'{step}°' for step in steps)],
                    [[name, side, *(_cell(s['cone'][side][step]['at_20m'], 'coverage', 'median')
                                    for step in steps)]
                     for name, s in scored.items() for side in ('ahead', 'behind')])


def _moving(scored: Summaries) -> Iterator[tuple[str, str]]:
    columns = {'farther': 'over 10 % farther', 'much_farther': 'over 1.5 times farther',
               'unknown': 'unknown', 'marked': 'marked', 'falsely_marked': 'still, but marked'}
    rows = [[name, *(_number(s['moving'].get(column)) for column in columns)]
            for name, s in scored.items() if 'moving' in s]
    if rows:
        yield ('What moves by itself, in % of its solid angle',
               markdown(['method', *columns.values()], rows))
