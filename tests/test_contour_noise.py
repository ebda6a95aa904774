"""The covariance of distances from pieces of contour, against numpy's products piece by piece."""

from __future__ import annotations

import numpy as np

from contour_rooms import block_log, events_of, mapper
from kalmap.kernels.contour_noise import fill_noise
from kalmap.kernels.implicit import distance_rows
from kalmap.records import Scan
from kalmap.slam.contours.seen import prepare


def test_points_on_one_piece_err_together():
    log = block_log()
    scan = next(event for event in events_of(log, 3) if isinstance(event, Scan))
    pieces = prepare(scan, mapper(log).rules, np.zeros(4), np.zeros(3)).pieces
    beams = np.flatnonzero(pieces.piece >= 0)[::3]
    points, piece = np.ascontiguousarray(pieces.points[beams]), pieces.piece[beams]
    noise = np.empty((len(points), len(points)))
    fill_noise(
        points, piece, pieces.coef, pieces.cov, pieces.origin, pieces.scale, pieces.sigma, pieces.ends,
        pieces.lengths, 0.01**2, 0.002**2, noise,
    )  # fmt: skip
    told = np.zeros_like(noise)
    assert len(np.unique(piece)) > 3
    for k in np.unique(piece):
        at = np.flatnonzero(piece == k)
        rows = np.empty((len(at), 10))
        distance_rows(pieces.coef[k], *pieces.origin[k], pieces.scale[k], points[at], rows)
        lever = (points[at] - pieces.origin[k]) @ (pieces.ends[k, 1] - pieces.ends[k, 0]) / pieces.lengths[k]
        block = rows @ pieces.cov[k] @ rows.T + 0.01**2 + 0.002**2 * np.outer(lever, lever)
        told[np.ix_(at, at)] = block + pieces.sigma[k] ** 2 * np.eye(len(at))
    assert np.allclose(noise, told, rtol=1e-10, atol=1e-18)
