"""Stretches of contour that two maps share, and what it says of their samples that they lie on one curve."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from kalmap.geometry.curve_fit import fit_curve
from kalmap.geometry.curves import TERMS_OF_ORDER, Curve
from kalmap.slam.contours.closed import ClosedMap, neighbours
from kalmap.slam.contours.stacked import Constraint, Stacked
from kalmap.slam.contours.strands import strands

Noise = Literal["curve", "zero"]

SIGMA = 0.015  # m, standard deviation of samples about a contour's curve by which its order is chosen
ROUGHNESS = 0.005  # m, the least that a contour is rough about its curve
FACING = 0.8  # cosine between normals of contours that may be one
GAP = 2.2  # spacings between samples beyond which a stretch ends
LONGEST = 4.0  # m of a stretch that one curve stands for
FEWEST = 4  # samples of a stretch, two or more of each map


class Stretch(msgspec.Struct, frozen=True, eq=False):
    """Samples of both maps along one contour, and the curve through them.

    rows: (K,) in order along it, those of the second map counted on behind the first's. curve: in the first map's
    frame, p growing towards the free side. roughness: m.
    """

    rows: np.ndarray
    curve: Curve
    roughness: float


def shared_stretches(
    first: ClosedMap,
    second: ClosedMap,
    samples: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    limit: float,
) -> list[Stretch]:
    """Stretches where samples of the second lie within `limit` m of the first's contours and face the same way.

    samples: (N1, 2) of the first. places, normals: (N2, 2) of the second, put where they are thought to lie on the
    first (NaN: left out), which decides what belongs together and nothing else.
    """
    pairs = neighbours(samples, first.normals, first.spacing)
    strand_of = [rows for rows in strands(pairs, len(samples)) if len(rows) >= 2]
    if not strand_of:
        return []
    number, along, offset = _beside(samples, first.normals, strand_of, places, normals, limit)
    found: list[Stretch] = []
    for k, rows in enumerate(strand_of):
        mine = np.flatnonzero(number == k)
        if len(mine) < 2:
            continue
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(samples[rows], axis=0).T))])
        if rows[0] == rows[-1]:
            rows, way = rows[:-1], way[:-1]
        other = along[mine]
        nearest = np.abs(way[:, None] - other[None]).min(axis=1)
        kept = nearest <= 1.2 * first.spacing
        row = np.concatenate([rows[kept], len(samples) + mine])
        at = np.concatenate([way[kept], other])
        order = np.argsort(at, kind="stable")
        row, at = row[order], at[order]
        facing = np.concatenate([first.normals, normals])
        points = np.concatenate([samples, _detrended(places, normals, mine, other, offset[mine])])
        breaks = np.flatnonzero(np.diff(at) > GAP * first.spacing) + 1
        for part in np.split(np.arange(len(row)), breaks):
            found += _fitted(row[part], at[part], points, facing, len(samples))
    return found


def _beside(
    samples: np.ndarray,
    facing: np.ndarray,
    strand_of: list[np.ndarray],
    places: np.ndarray,
    normals: np.ndarray,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every place the strand that it lies beside or -1, how far along that, m, and its signed offset, m."""
    ends = np.concatenate([np.column_stack([rows[:-1], rows[1:]]) for rows in strand_of])
    strand = np.concatenate([np.full(len(rows) - 1, k) for k, rows in enumerate(strand_of)])
    base, way = samples[ends[:, 0]], samples[ends[:, 1]] - samples[ends[:, 0]]
    length = np.maximum(1e-9, np.hypot(*way.T))
    before = np.concatenate(
        [np.cumsum(length[strand == k]) - length[strand == k] for k in range(len(strand_of))]
    )
    across = facing[ends].sum(axis=1)
    across /= np.maximum(1e-9, np.hypot(*across.T))[:, None]
    number, along, offset = (np.full(len(places), -1), np.zeros(len(places)), np.zeros(len(places)))
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    near = min(8, len(base))
    _, candidates = cKDTree(base + 0.5 * way).query(places[known], k=near)
    candidates = candidates.reshape(len(known), near)
    arm = places[known][:, None] - base[candidates]
    t = (arm * way[candidates]).sum(axis=2) / length[candidates] ** 2
    off = (arm * across[candidates]).sum(axis=2)
    faces = (across[candidates] * normals[known][:, None]).sum(axis=2) > FACING
    beyond = np.maximum(0.0, np.maximum(-t, t - 1.0)) * length[candidates]
    cost = np.where(faces & (np.abs(off) < limit) & (beyond < 0.25), np.abs(off) + beyond, np.inf)
    best = cost.argmin(axis=1)
    row = np.arange(len(known))
    good = np.isfinite(cost[row, best])
    chosen = candidates[row, best]
    number[known] = np.where(good, strand[chosen], -1)
    along[known] = before[chosen] + t[row, best] * length[chosen]
    offset[known] = off[row, best]
    return number, along, offset


def _detrended(
    places: np.ndarray, normals: np.ndarray, mine: np.ndarray, along: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """The places with what a shift and a turn of that contour explain of their offsets taken out.

    So that the curve's order is chosen by the shape of the contour, not by how far apart the maps lie.
    """
    moved = places.copy()
    design = np.column_stack([np.ones(len(mine)), along - along.mean()])
    if np.ptp(along) < 0.5:
        design = design[:, :1]
    trend = design @ np.linalg.lstsq(design, offset, rcond=None)[0]
    moved[mine] -= trend[:, None] * normals[mine]
    return moved


def _fitted(
    rows: np.ndarray, at: np.ndarray, points: np.ndarray, normals: np.ndarray, first_count: int
) -> list[Stretch]:
    """The curve through a stretch; cut in two where it is too long, or no curve explains it."""
    of_second = rows >= first_count
    if len(rows) < FEWEST or of_second.sum() < 2 or (~of_second).sum() < 2:
        return []
    if at[-1] - at[0] <= LONGEST:
        fit = fit_curve(points[rows], np.full(len(rows), SIGMA**2))
        if fit.explained and np.abs(fit.residuals).max() < 4.0 * SIGMA:
            curve = _facing(fit.curve, points[rows], normals[rows])
            if curve is not None:
                return [Stretch(rows, curve, max(ROUGHNESS, fit.roughness))]
    cut = _middle(at)
    parts = (slice(None, cut), slice(cut, None))
    return [each for part in parts for each in _fitted(rows[part], at[part], points, normals, first_count)]


def _middle(at: np.ndarray) -> int:
    """Where to cut: the sample nearest to the middle of the way."""
    return int(np.clip(np.searchsorted(at, 0.5 * (at[0] + at[-1])), 1, len(at) - 1))


def _facing(curve: Curve, points: np.ndarray, normals: np.ndarray) -> Curve | None:
    """The curve with p growing the way that the samples face; None where they do not agree on it."""
    slope = curve.gradient(points)
    side = (slope * normals).sum(axis=1) / np.maximum(1e-12, np.hypot(*slope.T))
    if np.abs(side).min() < 0.5 or (not (side > 0.0).all() and not (side < 0.0).all()):
        return None
    if side[0] > 0.0:
        return curve
    return msgspec.structs.replace(curve, coefficients=-curve.coefficients)


def null_space(curve: Curve, points: np.ndarray) -> np.ndarray:
    """N (K, K - p), orthonormal: what of K distances no small change of the curve's p free coefficients explains."""
    terms = TERMS_OF_ORDER[curve.order]
    shape = curve.coefficients[:terms] / np.linalg.norm(curve.coefficients[:terms])
    by_shape = curve.noise_rows(points)[:, :terms]
    by_shape = by_shape - np.outer(by_shape @ shape, shape)  # along itself a polynomial only grows
    basis, sizes, _ = np.linalg.svd(by_shape, full_matrices=True)
    free = min(terms - 1, int((sizes > 1e-9 * sizes[0]).sum()))
    return basis[:, free:]


def on_one_curve(stacked: Stacked, mean: np.ndarray, stretch: Stretch, noise: Noise) -> Constraint:
    """The signed distances of a stretch's samples, in either map's own frame, as virtual measurements of 0.

    noise "zero" is the paper's: all of them are 0 exactly, of a curve that is taken as given. But the curve was fitted
    to these very samples, and knows no more than they do: N samples of one straight wall then claim N exact facts
    where there are N - 2. "curve" leaves the curve open: only what no curve of that order explains is measured, which
    is the limit of a curve whose coefficients are wholly uncertain, and with the contour's roughness for its noise.
    """
    places = np.concatenate([stacked.first(mean), stacked.placed(mean)])[stretch.rows]
    value, slope = stretch.curve.distance_and_gradient(places)
    if not (
        np.isfinite(value).all() and np.isfinite(slope).all()
    ):  # at a place where the curve has no direction
        return Constraint(csr_array((0, len(mean))), np.zeros(0), np.zeros((0, 0)))
    rows = stacked.rows(mean, stretch.rows, slope)
    if noise == "zero":
        return Constraint(rows, value, np.zeros((len(value), len(value))))
    feet = stretch.curve.project(places) if stretch.curve.order > 1 else places
    left = null_space(stretch.curve, np.where(np.isfinite(feet), feet, places))
    return Constraint(csr_array(left.T) @ rows, left.T @ value, stretch.roughness**2 * np.eye(left.shape[1]))
