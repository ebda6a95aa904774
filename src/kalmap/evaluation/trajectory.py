"""How far a trajectory is from its reference."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.alignment import align, apply
from kalmap.geometry.angles import wrap
from kalmap.records import Reference


class Matched(msgspec.Struct, frozen=True, eq=False):
    """Estimated and reference poses of the same instants.

    rows: (K,) which of the trajectory's rows these are. estimated: (K, 3) x, y, heading, x and y of the
    reference's point of the vehicle. reference: (K, 3), heading NaN where the reference does not know it.
    """

    rows: np.ndarray
    estimated: np.ndarray
    reference: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)


class ErrorSummary(msgspec.Struct, frozen=True):
    """Position errors in m. trimmed_rmse: the RMS of those left when the largest share is cut off."""

    rmse: float
    mean: float
    median: float
    max: float
    trimmed_rmse: float


class RelativeError(msgspec.Struct, frozen=True):
    """RMS errors of relative motion over one distance: m and rad, and over how many pairs."""

    distance: float
    translation_rmse: float
    rotation_rmse: float
    pairs: int


def match(times: np.ndarray, poses: np.ndarray, reference: Reference, max_gap: float = 2.0) -> Matched:
    """Interpolate the reference at the trajectory's times: linear in position, the short way in heading.

    times (F,) s, poses (F, 3). Times outside the reference's span and inside holes longer than `max_gap`
    (s) are left out, as are reference samples without a finite position.
    """
    times, poses = np.asarray(times, dtype=float), np.asarray(poses, dtype=float)
    good = np.isfinite(reference.times) & np.isfinite(reference.positions).all(axis=1)
    known, positions, headings = reference.times[good], reference.positions[good], reference.headings[good]
    if len(known) == 0 or len(times) == 0:
        return Matched(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    after = np.clip(np.searchsorted(known, times), 1, max(1, len(known) - 1))
    before = after - 1
    after = np.minimum(after, len(known) - 1)
    gap = known[after] - known[before]
    share = np.divide(times - known[before], gap, out=np.zeros(len(times)), where=gap > 0)
    exact = (times == known[before]) | (times == known[after])
    inside = (times >= known[0]) & (times <= known[-1]) & (exact | (gap <= max_gap))
    rows = np.nonzero(inside & np.isfinite(poses).all(axis=1))[0]
    before, after, share = before[rows], after[rows], share[rows]
    position = positions[before] + share[:, None] * (positions[after] - positions[before])
    heading = _between(headings[before], headings[after], share)
    return Matched(rows, at_point(poses[rows], reference.point), np.column_stack([position, heading]))


def _between(first: np.ndarray, last: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Headings between two others; at an end itself, the other end need not be known."""
    turned = wrap(first + share * wrap(last - first))
    return np.where(share == 0, wrap(first), np.where(share == 1, wrap(last), turned))


def at_point(poses: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(K, 3) poses with x and y of a `point` (forward, left; m) of the vehicle instead of its origin."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    forward, left = float(point[0]), float(point[1])
    x = poses[:, 0] + c * forward - s * left
    y = poses[:, 1] + s * forward + c * left
    return np.column_stack([x, y, poses[:, 2]])


def aligned(matched: Matched) -> tuple[Matched, tuple[float, np.ndarray]]:
    """The same with the estimate brought onto the reference by one rigid motion, and that motion."""
    angle, translation = align(matched.estimated[:, :2], matched.reference[:, :2])
    moved = apply(angle, translation, matched.estimated[:, :2])
    estimated = np.column_stack([moved, wrap(matched.estimated[:, 2] + angle)])
    return Matched(matched.rows, estimated, matched.reference), (angle, translation)


def position_errors(matched: Matched) -> np.ndarray:
    """(K,) distance in m of each estimated position from the reference."""
    return np.asarray(np.hypot(*(matched.estimated[:, :2] - matched.reference[:, :2]).T))


def heading_errors(matched: Matched) -> np.ndarray:
    """(K',) signed heading errors in rad, wrapped, where the reference knows the heading."""
    errors = wrap(matched.estimated[:, 2] - matched.reference[:, 2])
    return errors[np.isfinite(errors)]


def rms(values: np.ndarray) -> float | None:
    """Root of the mean square; None without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def summarise(errors: np.ndarray, trim: float = 0.1) -> ErrorSummary | None:
    """Summary of position errors (K,), None for none; `trimmed_rmse` leaves out the largest `trim` share."""
    if len(errors) == 0:
        return None
    kept = np.sort(errors)[: max(1, int(np.ceil((1.0 - trim) * len(errors))))]
    return ErrorSummary(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        max=float(np.max(errors)),
        trimmed_rmse=float(np.sqrt(np.mean(kept**2))),
    )


def absolute_trajectory_error(
    matched: Matched, *, align_first: bool, trim: float = 0.1
) -> ErrorSummary | None:
    """ATE: position errors as they are, or after the best rigid alignment (Sturm et al. 2012, eq. 3)."""
    if align_first and len(matched):
        matched, _ = aligned(matched)
    return summarise(position_errors(matched), trim)


def relative_errors(matched: Matched, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the motion from row `first` to row `last` (P,): translation m and rotation rad (wrapped).

    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) with reference Q and estimate P (Sturm et al. 2012, eq. 1); the
    translation error is |trans E|, which is the difference of both motions seen from their own start.
    """
    estimated = _motion(matched.estimated[first], matched.estimated[last])
    reference = _motion(matched.reference[first], matched.reference[last])
    translation = np.hypot(*(estimated[:, :2] - reference[:, :2]).T)
    return translation, wrap(estimated[:, 2] - reference[:, 2])


def _motion(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    dx, dy = (end[:, :2] - start[:, :2]).T
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    return np.column_stack([c * dx + s * dy, -s * dx + c * dy, end[:, 2] - start[:, 2]])


def relative_pose_error(matched: Matched, distances: tuple[float, ...]) -> list[RelativeError]:
    """RPE over distances driven (m, along the reference): every start is paired with the first instant at
    least that far on. Distances that no pair covers, and starts without a reference heading, are left out.
    """
    headed = np.isfinite(matched.reference[:, 2])
    matched = Matched(matched.rows[headed], matched.estimated[headed], matched.reference[headed])
    legs = np.hypot(*np.diff(matched.reference[:, :2], axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(legs)])[: len(matched)]
    results = []
    for distance in distances:
        last = np.searchsorted(way, way + distance)
        first = np.nonzero(last < len(way))[0]
        if len(first):
            translation, rotation = relative_errors(matched, first, last[first])
            translation_rmse, rotation_rmse = np.sqrt([np.mean(translation**2), np.mean(rotation**2)])
            results.append(
                RelativeError(float(distance), float(translation_rmse), float(rotation_rmse), len(first))
            )
    return results
