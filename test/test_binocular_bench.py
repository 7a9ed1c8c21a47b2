"""The accuracy benchmark of two cameras: figures against exact truth, folders, bad input."""
from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from two_cameras import view

from sphstereo_ros import cli
from sphstereo_ros.bench.binocular import PairContest, parameters, saved_pairs, table
from sphstereo_ros.scenes.sequence import FIRST_STAMP, TruthFrame, save_sequence


def truth(side: str, forward: float = 0.0) -> TruthFrame:
    seen = view(side, forward)  # type: ignore[arg-type]
    return TruthFrame(FIRST_STAMP, cv2.cvtColor(seen.image, cv2.COLOR_GRAY2BGR), seen.range,
                      seen.rotation, seen.position)


def folder(path: Path) -> Path:
    save_sequence([truth('bottom'), truth('top')], path)
    file = path / 'meta.json'
    meta = json.loads(file.read_text())
    meta['pairs'] = [{'bottom': 0, 'top': 1}]
    file.write_text(json.dumps(meta))
    return path


def test_figures_of_a_pair() -> None:
    contest = PairContest({'default': parameters('default', {'pairing.motion': False}),
                           'bm': parameters('bm', {})})
    contest.add([(truth('top'), truth('bottom'))] * 2)
    summaries = contest.summaries()
    for name, least in (('default', 85), ('bm', 70)):
        told = summaries[name]
        assert told['frames'] == 2
        assert told['alignment_deg'] < 0.05  # found by itself: the top camera is turned by 3°
        assert told['0-10']['coverage'] > least
        assert told['0-10']['median'] < 2.0
    assert 'default' in table(summaries)


def test_folders_and_what_is_wrong_with_them(tmp_path: Path,
                                             capsys: pytest.CaptureFixture[str]) -> None:
    (top, bottom), = saved_pairs(folder(tmp_path / 'rig'))
    assert (bottom.range == view('bottom').range).mean() < 1  # rounded on file
    assert abs(top.position - view('top').position).max() < 1e-9
    words = ['bench', 'accuracy', '--binocular', '--methods', 'bm', '--json']
    assert cli.main([*words, str(tmp_path / 'rig')]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told['bm']['frames'] == 1
    save_sequence([truth('bottom')], tmp_path / 'one')
    for wrong in ('one', 'missing'):
        assert cli.main([*words, str(tmp_path / wrong)]) == 2
        assert 'no pairs of frames' in capsys.readouterr().err
    assert cli.main(['bench', 'accuracy', '--binocular', '--methods', 'magic']) == 2
    assert 'magic' in capsys.readouterr().err
