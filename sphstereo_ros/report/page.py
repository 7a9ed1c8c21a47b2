"""The report's page: one HTML file with all that it shows inside."""
from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sphstereo_ros import __version__
from sphstereo_ros.core.frames import Image8, PointCloud
from sphstereo_ros.core.preview import FAR, NEAR
from sphstereo_ros.replay.ply import write_ply
from sphstereo_ros.report.clouds import thinned
from sphstereo_ros.report.contents import Contents, ShownFrame
from sphstereo_ros.report.figures import all_figures
from sphstereo_ros.report.summary import summarise
from sphstereo_ros.report.tracks import Track, laid_over

# Points inside the page: 10 bytes each, a third more as text.
PAGE_POINTS = 150_000
_TRACK_POINTS = 2000
_JPEG_QUALITY, _DPI = 80, 100
_WIDTH = 640
# Steps of the logarithmic scale that sigma is stored on: 0 is unknown, 1 … 255 from 1 mm to 10 m.
_SIGMA = (1e-3, 10.0)


def write_report(contents: Contents, folder: Path, title: str, command: str) -> list[Path]:
    """Write index.html, report.json, cloud.ply and PNGs into `folder`; returns their paths.

    title : what was reported on; command : how, for the foot of the page
    """
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarise(contents)
    figures = {name: _png(figure) for name, figure in all_figures(contents).items()}
    written = [_write(folder / f'{name}.png', data) for name, data in figures.items()]
    previews = folder / 'previews'
    if contents.frames:
        previews.mkdir(exist_ok=True)
        written += [_write_picture(previews / f'{index:04d}.png', frame)
                    for index, frame in enumerate(contents.frames)]
    if contents.cloud is not None:
        write_ply(folder / 'cloud.ply', contents.cloud)
        written.append(folder / 'cloud.ply')
    text = json.dumps(summary, indent=1, ensure_ascii=False) + '\n'
    written.append(_write(folder / 'report.json', text.encode()))
    page = _page(contents, summary, figures, title, command)
    return [_write(folder / 'index.html', page.encode()), *written]


def _write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _png(figure: Figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, dpi=_DPI)
    return data.getvalue()


def _write_picture(path: Path, frame: ShownFrame) -> Path:
    pictures = [_sized(p) for p in (frame.image, frame.depth) if p is not None]
    return _write(path, cv2.imencode('.png', np.vstack(pictures))[1].tobytes())


def _sized(picture: Image8) -> Image8:
    if picture.shape[1] == _WIDTH:
        return picture
    size = (_WIDTH, round(_WIDTH * picture.shape[0] / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _data_url(data: bytes, kind: str) -> str:
    return f'data:{kind};base64,{base64.b64encode(data).decode()}'


def _jpeg(picture: Image8 | None) -> str:
    if picture is None:
        return ''
    done = cv2.imencode('.jpg', _sized(picture), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return _data_url(done[1].tobytes(), 'image/jpeg')


def _page(contents: Contents, summary: Mapping[str, Any], figures: Mapping[str, bytes],
          title: str, command: str) -> str:
    environment = Environment(loader=PackageLoader('sphstereo_ros.report', 'web'),
                              autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                              lstrip_blocks=True)
    environment.filters['figure'] = _figure
    frames = contents.frames
    start = frames[0].stamp if frames else 0
    # As they stand in <script>: only the closing tag must not occur, and does not.
    scripts = {name: Markup((files('sphstereo_ros.report') / 'web' / name).read_text('utf-8'))
               for name in (('three.min.js', 'page.js') if contents.cloud is not None
                            else ('page.js',))}
    scene = scene_data(contents.cloud, contents.tracks) if contents.cloud is not None else None
    return environment.get_template('page.html.j2').render(
        title=title, command=command, version=__version__, scripts=scripts, scene=scene,
        figures={name: _data_url(data, 'image/png') for name, data in figures.items()},
        frames=[{'depth': _jpeg(f.depth), 'image': _jpeg(f.image),
                 'seconds': (f.stamp - start) / 1e9} for f in frames],
        near=NEAR, far=FAR, page_points=PAGE_POINTS, metric=contents.is_metric, **summary)


def _figure(value: float | None, digits: int = 1) -> str:
    """A number for people; a dash where it is unknown."""
    return '–' if value is None else f'{value:,.{digits}f}'


def scene_data(cloud: PointCloud, tracks: Sequence[Track]) -> dict[str, Any]:
    """Points and tracks as the page's script takes them; NumPy's bytes in base64.

    positions : uint16 x, y, z in `step` metres from `origin`; colours : uint8 RGB, or grey;
    sigma : uint8 on a logarithmic scale of 1 … 255, 0 unknown
    """
    points = thinned(cloud, PAGE_POINTS)
    origin = points.xyz.min(axis=0).astype(np.float64)
    step = max(float((points.xyz - origin).max()) / 65535, 1e-6)
    positions = np.round((points.xyz - origin) / step).astype('<u2')
    if points.bgr is not None:
        colours = points.bgr[:, ::-1]
    else:
        grey = points.intensity if points.intensity is not None else np.full(
            len(points.xyz), 128, np.uint8)
        colours = np.repeat(grey[:, None], 3, axis=1)
    return {'count': len(points.xyz), 'of': len(cloud.xyz), 'origin': origin.tolist(),
            'step': step, 'positions': _base64(positions), 'colours': _base64(colours),
            'has_colours': points.bgr is not None or points.intensity is not None,
            'sigma': _base64(sigma_codes(points.sigma)), 'has_sigma': bool(
                np.isfinite(points.sigma).any()),
            'tracks': [_track_data(track, tracks[0]) for track in tracks]}


def _track_data(track: Track, first: Track) -> dict[str, Any]:
    drawn = track if track is first else laid_over(track, first) or track
    positions = drawn.positions[::max(1, len(drawn.positions) // _TRACK_POINTS)]
    return {'name': track.name, 'positions': np.round(positions, 3).tolist()}


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def sigma_codes(sigma: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Sigma (m) on the page's scale: 0 unknown, 1 … 255 logarithmic from 1 mm to 10 m."""
    known = np.isfinite(sigma) & (sigma > 0)
    low, high = np.log(_SIGMA)
    with np.errstate(invalid='ignore', divide='ignore'):
        level = (np.log(np.where(known, sigma, 1.0)) - low) / (high - low)
    return np.where(known, 1 + np.round(254 * np.clip(level, 0, 1)), 0).astype(np.uint8)
