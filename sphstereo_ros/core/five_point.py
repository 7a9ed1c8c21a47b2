"""The five-point minimal solver on bearing vectors, for many samples at once.

Nistér, "An efficient solution to the five-point relative pose problem" (2004), with the Gröbner
basis and action matrix of Stewénius, Engels and Nistér (2006). Bearings point anywhere on the
sphere: nothing is divided by z.
"""
from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# The twenty monomials of degree ≤ 3 in x, y, z; the last ten span the quotient ring.
_MONOMIALS = ('xxx', 'xxy', 'xyy', 'yyy', 'xxz', 'xyz', 'yyz', 'xzz', 'yzz', 'zzz',
              'xx1', 'xy1', 'yy1', 'xz1', 'yz1', 'zz1', 'x11', 'y11', 'z11', '111')
_REDUCED = (0, 1, 2, 4, 5, 7)  # x times the first six of the basis: cubic, reduced by the ideal
_SHIFTED = (0, 1, 3, 6)  # x times x, y, z, 1: where they stand in the basis


def _collector() -> Floats:
    """(64, 20): sums the coefficients of x_i x_j x_k, all orders, into those of a monomial."""
    index = {''.join(sorted(m, key='xyz1'.index)): n for n, m in enumerate(_MONOMIALS)}
    out = np.zeros((64, 20))
    for row, ijk in enumerate(product('xyz1', repeat=3)):
        out[row, index[''.join(sorted(ijk, key='xyz1'.index))]] = 1
    return out


_COLLECT = _collector()

# The null space that an SVD gives can have axes along which the true E has no weight (sideways
# motion without rotation): turned by this, it has none that a motion would be likely to meet.
_TURN = np.linalg.qr(np.vander([0.3, 0.7, 1.1, 1.9]))[0]


def _constraints(basis: Floats) -> Floats:
    """Coefficients (N, 10, 20) of det E = 0 and 2EEᵀE − tr(EEᵀ)E = 0, for bases (N, 4, 3, 3)."""
    pairs = np.einsum('niab,njcb->nijac', basis, basis)
    traces = np.trace(pairs, axis1=-2, axis2=-1)
    cubic = 2 * np.einsum('nijab,nkbc->nijkac', pairs, basis) \
        - np.einsum('nij,nkac->nijkac', traces, basis)
    cross = np.cross(basis[:, :, None, 1], basis[:, None, :, 2])
    det = np.einsum('nia,njka->nijk', basis[:, :, 0], cross)
    n = len(basis)
    return np.concatenate([np.swapaxes(cubic.reshape(n, 64, 9), 1, 2) @ _COLLECT,
                           (det.reshape(n, 1, 64) @ _COLLECT)], axis=1)


def essential_matrices(reference: Floats, current: Floats) -> Floats:
    """All essential matrices that fit samples of five correspondences.

    Parameters
    ----------
    reference, current : (N, 5, 3) bearings in the two views

    Returns
    -------
    (M, 3, 3) matrices E with currentᵀ E reference = 0 and E = [p]× R for X_cur = R X_ref + p, of
    norm 1; the real solutions of all samples that are not degenerate, at most 10 a sample.

    """
    n = len(reference)
    rows = np.einsum('nka,nkb->nkab', current, reference).reshape(n, 5, 9)
    null_space = np.linalg.svd(rows, full_matrices=True)[2][:, 5:]
    basis = (_TURN @ null_space).reshape(n, 4, 3, 3)
    m = _constraints(basis)
    good = np.linalg.cond(m[:, :, :10]) < 1e12
    basis, m = basis[good], m[good]
    reduced = np.linalg.solve(m[:, :, :10], m[:, :, 10:])
    action = np.zeros((len(m), 10, 10))
    action[:, :6] = -reduced[:, _REDUCED]
    action[:, range(6, 10), _SHIFTED] = 1
    values, vectors = np.linalg.eig(action)
    sample, root = np.nonzero((np.abs(values.imag) < 1e-8) & (np.abs(vectors[:, 9]) > 1e-12))
    solution = vectors[sample, :, root].real
    weights = np.concatenate([solution[:, 6:9] / solution[:, 9:], np.ones((len(root), 1))], axis=1)
    e = np.einsum('mi,miab->mab', weights, basis[sample])
    return np.asarray(e / np.linalg.norm(e, axis=(1, 2), keepdims=True))


def decompose(essential: Floats) -> list[tuple[Floats, Floats]]:
    """The four (R, p) with E ∝ [p]× R and |p| = 1 of one essential matrix (3, 3)."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.linalg.det(u), vt * np.linalg.det(vt)
    w = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return [(u @ turn @ vt, sign * u[:, 2]) for turn in (w, w.T) for sign in (1, -1)]
