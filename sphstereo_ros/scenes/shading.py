"""Kernels of the renderer: exact hit points, band-limited textures, light and sky.

Textures are functions of the hit point in the object's axes. Detail fades out as the footprint
of the pixel grows past it, so that nothing aliases.
"""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.jit import fast_kernel, kernel

Array = NDArray[Any]

NO_HIT = -1
_SHADOW_LIFT = 2e-3  # metres by which a shadow ray starts off its surface
_SUN_RADIUS = 0.0046  # rad
_GOLDEN = 2.399963229728653


@kernel
def pixel_rays(height: int, pixels: Array, offsets: Array, rotation: Array, rays: Array) -> None:
    """Unit world directions `rays` (n·k, 3) through `pixels` (n,) flat indices of a full sphere.

    offsets : (k, 2) from the pixel's centre, in pixels; rotation : (3, 3) world ← camera_optical
    """
    width = 2 * height
    count = offsets.shape[0]
    for i in range(pixels.shape[0]):
        for k in range(count):
            u = pixels[i] % width + 0.5 + offsets[k, 0]
            v = pixels[i] // width + 0.5 + offsets[k, 1]
            lon = 2 * math.pi * (u / width - 0.5)
            lat = math.pi * (0.5 - v / height)
            x = math.cos(lat) * math.sin(lon)
            y = -math.sin(lat)
            z = math.cos(lat) * math.cos(lon)
            for a in range(3):
                rays[i * count + k, a] = (rotation[a, 0] * x + rotation[a, 1] * y
                                          + rotation[a, 2] * z)


@kernel
def plane_distance(origins: Array, rays: Array, triangles: Array, anchors: Array, normals: Array,
                   distance: Array) -> None:
    """Distance (n,) along `rays` to the plane of the triangle each of them hit; inf for none.

    anchors, normals : (t, 3) a vertex and the unit normal of every triangle. This is float64,
    where the ray caster's own distance is float32.
    """
    for i in range(rays.shape[0]):
        t = triangles[i]
        if t < 0:
            distance[i] = np.inf
            continue
        above = 0.0
        rate = 0.0
        for a in range(3):
            above += (anchors[t, a] - origins[i, a]) * normals[t, a]
            rate += rays[i, a] * normals[t, a]
        distance[i] = above / rate


@fast_kernel
def _random(x: int, y: int, z: int, seed: int) -> float:
    h = x * 374761393 + y * 668265263 + z * 2147483629 + seed * 1274126177
    h = (h ^ (h >> 13)) * 1274126177
    h = (h ^ (h >> 15)) * 2246822519
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777215.0


@fast_kernel
def _noise(x: float, y: float, z: float, seed: int) -> float:
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    x, y, z = x - fx, y - fy, z - fz
    x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
    a = _random(i, j, k, seed) * (1 - x) + _random(i + 1, j, k, seed) * x
    b = _random(i, j + 1, k, seed) * (1 - x) + _random(i + 1, j + 1, k, seed) * x
    c = _random(i, j, k + 1, seed) * (1 - x) + _random(i + 1, j, k + 1, seed) * x
    d = _random(i, j + 1, k + 1, seed) * (1 - x) + _random(i + 1, j + 1, k + 1, seed) * x
    return 2 * ((a * (1 - y) + b * y) * (1 - z) + (c * (1 - y) + d * y) * z) - 1


@fast_kernel
def octaves(x: float, y: float, z: float, size: float, fine: float, gain: float,
            footprint: float, seed: int) -> float:
    """Noise of cell `size`, halved down to `fine`; cells under two footprints fade out."""
    total = 0.0
    amplitude = 1.0
    while size > footprint and size >= fine:
        fade = min(1.0, size / footprint - 1.0)
        total += amplitude * fade * _noise(x / size, y / size, z / size, seed)
        # Turned from octave to octave: the lattice stays hidden.
        x, y = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y
        y, z = 0.8 * y - 0.6 * z, 0.6 * y + 0.8 * z
        amplitude *= gain
        size *= 0.5
        seed += 17
    return total


@fast_kernel
def _joint(position: float, period: float, joint: float, footprint: float) -> float:
    inside = position - period * math.floor(position / period)
    edge = min(inside, period - inside)
    cover = min(1.0, max(0.0, (0.5 * joint - edge) / footprint + 0.5))
    cover *= min(1.0, joint / footprint)
    fade = min(1.0, max(0.0, period / footprint - 1.0))
    return fade * cover + (1 - fade) * joint / period


@fast_kernel
def _blocks(material: Any, u: float, v: float, fu: float, fv: float, colour: Array) -> None:
    width, height = material.block[0], material.block[1]
    row = math.floor(v / height)
    u += material.block_offset * width * (int(row) % 2)
    column = math.floor(u / width)
    fade = min(1.0, max(0.0, min(width / fu, height / fv) - 1.0))
    tone = 1 + fade * material.block_variation * (
        2 * _random(int(column), int(row), 7, material.seed) - 1)
    lines = max(_joint(u, width, material.joint, fu), _joint(v, height, material.joint, fv))
    for c in range(3):
        colour[c] = (1 - lines) * colour[c] * tone + lines * material.joint_colour[c]


@fast_kernel
def _crack(material: Any, x: float, y: float, z: float, footprint: float) -> float:
    """Share (0 … 1) of the footprint that lies in a crack: where soft noise crosses zero."""
    size = material.crack_size
    if octaves(x, y, z, 3 * size, 3 * size, 1.0, 1e-3, material.seed + 31) < -0.1:
        return 0.0
    level = octaves(x, y, z, size, 0.06 * size, 0.5, 1e-3, material.seed + 37)
    beside = 0.3 * size * abs(level)  # about the distance in metres
    cover = min(1.0, max(0.0, (0.5 * material.crack - beside) / footprint + 0.5))
    depth: float = 0.7 * cover * min(1.0, material.crack / footprint)
    return depth


@fast_kernel
def texture(material: Any, point: Array, normal: Array, view: Array, footprint: float, face: int,
            colour: Array) -> None:
    """Reflectance `colour` (3,) at `point`; `view` and `normal` in the object's axes too."""
    cosine = max(0.03, abs(view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2]))
    # Between the ellipse's axes; the few rays a pixel make up for its length.
    wide = footprint / cosine**0.75
    x, y, z = point[0], point[1], point[2]
    stain = 0.0
    if material.stain > 0:
        stain = 0.5 + octaves(x, y, z, material.stain_size, 0.25 * material.stain_size, 0.5,
                              wide, material.seed)
        stain = material.stain * min(1.0, max(0.0, stain))
    tone = 1.0
    if material.grain > 0:
        tone += material.grain * octaves(
            x / material.stretch[0], y / material.stretch[1], z / material.stretch[2],
            material.grain_size, material.grain_fine, material.grain_gain, wide,
            material.seed + 5)
    if material.face_variation > 0:
        tone *= 1 + material.face_variation * (2 * _random(face // 2, 3, 1, material.seed) - 1)
    if material.dirt > 0:
        soil = 0.5 + 0.5 * _noise(2 * x, 2 * y, 1.5 * z, material.seed + 9)
        tone *= 1 - material.dirt * soil * math.exp(-max(z, 0.0) / 0.5)
    tone = min(2.0, max(0.15, tone))
    if material.crack > 0 and wide < 8 * material.crack:
        tone *= 1 - _crack(material, x, y, z, wide)
    for c in range(3):
        colour[c] = tone * ((1 - stain) * material.colour[c] + stain * material.stain_colour[c])
    if material.block[0] > 0:
        a, b = 0, 1
        if abs(normal[2]) < max(abs(normal[0]), abs(normal[1])):
            a, b = (1, 2) if abs(normal[0]) > abs(normal[1]) else (0, 2)
        # The footprint is an ellipse, long where the line of sight runs along the surface.
        along = (1 / (cosine * cosine) - 1) / max(1e-9, 1 - cosine * cosine)
        ta = view[a] + cosine * normal[a]
        tb = view[b] + cosine * normal[b]
        _blocks(material, point[a], point[b], footprint * math.sqrt(1 + along * ta * ta),
                footprint * math.sqrt(1 + along * tb * tb), colour)


@fast_kernel
def sky(x: float, y: float, z: float, light: Any, colour: Array) -> None:
    """Radiance `colour` (3,) of the sky in the direction (x, y, z): gradient, haze, clouds."""
    up = max(z, 0.0)
    haze = math.exp(-5.0 * up)
    cloud = octaves(x / (up + 0.25), y / (up + 0.25), 0.0, 0.9, 0.05, 0.55, 0.004, light.seed)
    cloud = light.clouds * min(1.0, max(0.0, 0.3 + 0.8 * cloud)) * (1 - 0.7 * haze)
    toward = x * light.sun[0] + y * light.sun[1] + z * light.sun[2]
    glow = light.sun_strength * (0.04 * max(0.0, toward) ** 8 + 0.25 * max(0.0, toward) ** 256
                                 + 12.0 * max(0.0, toward) ** 30000)
    for c in range(3):
        blue = (1 - haze) * light.zenith[c] + haze * light.horizon[c]
        colour[c] = (1 - cloud) * blue + cloud * light.cloud_colour[c] + glow * light.sun_colour[c]


@fast_kernel
def _lamplight(lamps: Array, point: Array, normal: Array, toward: Array) -> tuple[float, float,
                                                                                  float]:
    """(light of all lamps but the nearest, light of the nearest, its distance), unshadowed."""
    nearest = -1
    least = 1e9
    strongest = 0.0
    total = 0.0
    for k in range(lamps.shape[0]):
        dx, dy, dz = lamps[k, 0] - point[0], lamps[k, 1] - point[1], lamps[k, 2] - point[2]
        square = dx * dx + dy * dy + dz * dz + 0.05
        distance = math.sqrt(square)
        facing = max(0.0, (dx * normal[0] + dy * normal[1] + dz * normal[2]) / distance)
        down = max(0.0, dz / distance)
        power = lamps[k, 3] * facing * (0.25 + 0.75 * down) / square
        total += power
        if square < least:
            nearest, least, strongest = k, square, power
            toward[0], toward[1], toward[2] = dx / distance, dy / distance, dz / distance
    return total - strongest, strongest, math.sqrt(least) if nearest >= 0 else 0.0


@fast_kernel
def _corner_normal(corner_normals: Array, face: int, u: float, v: float, ray: Array,
                   flat: Array, normal: Array) -> None:
    """Interpolate the shading normal, turned to the viewer; `flat` is turned as well."""
    facing = flat[0] * ray[0] + flat[1] * ray[1] + flat[2] * ray[2]
    sign = -1.0 if facing > 0 else 1.0
    length = 0.0
    for a in range(3):
        flat[a] *= sign
        normal[a] = sign * ((1 - u - v) * corner_normals[face, 0, a]
                            + u * corner_normals[face, 1, a] + v * corner_normals[face, 2, a])
        length += normal[a] * normal[a]
    length = math.sqrt(max(length, 1e-12))
    seen = 0.0
    for a in range(3):
        normal[a] /= length
        seen += normal[a] * ray[a]
    if seen > -0.02:  # an interpolated normal may point away at the silhouette
        for a in range(3):
            normal[a] = flat[a]


@fast_kernel
def _tilt(normal: Array, face: int, amount: float, seed: int) -> None:
    length = 0.0
    for a in range(3):
        normal[a] += amount * (2 * _random(face // 2, a, 11, seed) - 1)
        length += normal[a] * normal[a]
    for a in range(3):
        normal[a] /= math.sqrt(length)


@fast_kernel
def _highlight(ray: Array, normal: Array, toward: Array, material: Any) -> float:
    hx, hy, hz = toward[0] - ray[0], toward[1] - ray[1], toward[2] - ray[2]
    length = math.sqrt(hx * hx + hy * hy + hz * hz) + 1e-9
    cosine = max(0.0, (hx * normal[0] + hy * normal[1] + hz * normal[2]) / length)
    strength: float = material.specular * (material.exponent + 8) / 25 * (
        cosine ** material.exponent)
    return strength


@fast_kernel
def _sunward(light: Any, sample: int, samples: int, toward: Array) -> None:
    """The direction to one of `samples` points of the sun's disc: shadows get soft edges."""
    radius = _SUN_RADIUS * math.sqrt((sample + 0.5) / samples)
    a, b = radius * math.cos(_GOLDEN * sample), radius * math.sin(_GOLDEN * sample)
    x, y, z = light.sun[0], light.sun[1], light.sun[2]
    flat = math.sqrt(x * x + y * y)
    toward[0] = x + (-a * y - b * z * x) / flat
    toward[1] = y + (a * x - b * z * y) / flat
    toward[2] = z + b * flat


@fast_kernel
def _into_part(place: Array, point: Array, normal: Array, ray: Array, here: Array, there: Array,
               view: Array) -> None:
    """Point, normal and ray in the axes of the part that is placed by `place` (3, 4)."""
    for a in range(3):
        here[a] = there[a] = view[a] = 0.0
        for b in range(3):
            here[a] += place[b, a] * (point[b] - place[b, 3])
            there[a] += place[b, a] * normal[b]
            view[a] += place[b, a] * ray[b]


@fast_kernel
def _sunlight(light: Any, material: Any, normal: Array, toward: Array) -> float:
    """Sunlight on the surface, some of it from behind through a leaf."""
    facing = normal[0] * toward[0] + normal[1] * toward[1] + normal[2] * toward[2]
    lit: float = light.sun_strength * max(facing, -material.translucent * facing)
    return lit


@fast_kernel
def _leave(point: Array, flat: Array, toward: Array, start: Array) -> None:
    """Where a ray along `toward` starts: off the surface, on the side that it leaves to."""
    side = flat[0] * toward[0] + flat[1] * toward[1] + flat[2] * toward[2]
    lift = math.copysign(_SHADOW_LIFT, side)
    for a in range(3):
        start[a] = point[a] + lift * flat[a]


@fast_kernel
def shade(samples: int, origins: Array, rays: Array, distance: Array, travelled: Array,
          angle: float, faces: Array, corners: Array, face_normals: Array, corner_normals: Array,
          face_part: Array, placements: Array, materials: Array, light: Any, lamps: Array,
          base: Array, direct: Array, shadow_from: Array, shadow_to: Array, shadow_length: Array,
          mirror: Array, mirror_rays: Array) -> None:
    """Shade the hits of `rays` (n, 3).

    `samples` consecutive rays belong to one pixel. Writes radiance that needs no more rays to
    `base` (n, 3), what the shadow ray decides over to `direct` (n, 3) with the ray itself in
    `shadow_*` (length 0: none to cast), and the weight of the mirror image to `mirror` (n,) with
    its direction in `mirror_rays` (n, 3).
    """
    point, flat, normal = np.empty(3), np.empty(3), np.empty(3)
    here, there, view, toward, colour = (np.empty(3), np.empty(3), np.empty(3), np.empty(3),
                                         np.empty(3))
    for i in range(rays.shape[0]):
        shadow_length[i] = 0.0
        mirror[i] = 0.0
        face = faces[i]
        ray = rays[i]
        if face < 0:
            sky(ray[0], ray[1], ray[2], light, colour)
            for c in range(3):
                base[i, c] = colour[c]
                direct[i, c] = 0.0
            continue
        part = face_part[face]
        material = materials[part]
        for a in range(3):
            point[a] = origins[i, a] + distance[i] * ray[a]
            flat[a] = face_normals[face, a]
        _corner_normal(corner_normals, face, corners[i, 0], corners[i, 1], ray, flat, normal)
        _into_part(placements[part], point, flat, ray, here, there, view)
        texture(material, here, there, view, angle * (travelled[i] + distance[i]), face, colour)
        if material.face_tilt > 0:
            _tilt(normal, face, material.face_tilt, material.seed)

        up = 0.5 + 0.5 * normal[2]
        rest, near, reach = 0.0, 0.0, 200.0
        if lamps.shape[0]:
            rest, near, reach = _lamplight(lamps, point, normal, toward)
        else:
            _sunward(light, i % samples, samples, toward)
            near = _sunlight(light, material, normal, toward)
        shine = 0.0
        if material.specular > 0 and near > 0:
            if lamps.shape[0] == 0:
                shine = light.sun_strength * _highlight(ray, normal, toward, material)
            elif material.mirror == 0:  # a mirror shows the lamps themselves
                shine = near * _highlight(ray, normal, toward, material)
        for c in range(3):
            ambient = up * light.from_above[c] + (1 - up) * light.from_below[c]
            base[i, c] = colour[c] * (ambient + rest * light.sun_colour[c] + material.emission)
            direct[i, c] = (colour[c] * near + shine) * light.sun_colour[c]
        if near > 0:
            shadow_length[i] = max(reach - 0.3, 1e-3) if lamps.shape[0] else reach
            shadow_to[i] = toward
            _leave(point, flat, toward, shadow_from[i])
        if material.mirror > 0:
            cosine = -(normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2])
            mirror[i] = material.mirror + (1 - material.mirror) * (1 - max(0.0, cosine)) ** 5
            for a in range(3):
                mirror_rays[i, a] = ray[a] + 2 * cosine * normal[a]
            if not near > 0:
                _leave(point, flat, mirror_rays[i], shadow_from[i])
