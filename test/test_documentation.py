"""What the documentation states agrees with the code."""
from __future__ import annotations

import re
from pathlib import Path

import pytest

from sphstereo_ros.cli import COMMANDS
from sphstereo_ros.core.config import PARAMETERS
from sphstereo_ros.replay.offline import TOPICS
from sphstereo_ros.ros.parameters import documentation_table

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / 'README.md').read_text(encoding='utf-8')
DOCUMENTS = [*ROOT.glob('*.md'), *(ROOT / 'doc').glob('*.md'), *(ROOT / 'bags').glob('*.md')]
# Causes of what only readers of results meet, or that others rename.
INSIDE = {'missing', 'missing_frame', 'no_message', 'unknown_fields'}
SENSORS = {'odometry_invalid', 'twist_invalid', 'imu_invalid', 'no_angular_velocity'}


def causes() -> set[str]:
    sources = (ROOT / 'sphstereo_ros').rglob('*.py')
    found = (re.findall(r"Drop\('([a-z_]+)'", s.read_text(encoding='utf-8')) for s in sources)
    return {cause for each in found for cause in each}


def test_table_of_parameters_is_up_to_date() -> None:
    # python -m sphstereo_ros.ros.parameters > doc/parameters.md
    assert (ROOT / 'doc' / 'parameters.md').read_text(encoding='utf-8') == documentation_table()


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda d: str(d.relative_to(ROOT)))
def test_links_lead_to_files(document: Path) -> None:
    for link in re.findall(r'\]\(([^)#]+)', document.read_text(encoding='utf-8')):
        assert link.startswith('http') or (document.parent / link).is_file(), link


def test_readme_explains_every_cause() -> None:
    found = causes()
    assert {'no_parallax', 'superseded'} <= found
    assert {c for c in found - INSIDE - SENSORS if f'`{c}`' not in README} == set()


def test_readme_names_every_topic_and_command() -> None:
    assert [t for t in TOPICS if f'`{t}`' not in README and f'`{t[1:]}`' not in README] == []
    assert [c for c in COMMANDS if f'`sphstereo {c} ' not in README] == []


def test_readme_names_no_parameter_that_is_not_there() -> None:
    groups = '|'.join({name.split('.')[0] for name in PARAMETERS})
    named = set(re.findall(rf'(?:`|-p )((?:{groups})\.[a-z_.]+)(?=`|:=)', README))
    assert {'baseline.length', 'range.max'} <= named
    assert named <= set(PARAMETERS)
