"""Two closed maps into one, the second beginning where the first ends (section 3 of Sun et al. 2010)."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.ellipses import chi_square
from kalmap.geometry.se2 import rotate
from kalmap.kernels import correlate
from kalmap.slam.contours.closed import CELL, ClosedMap, Shape
from kalmap.slam.contours.map_corners import corners_of, match_corners, same_corner
from kalmap.slam.contours.places import look_for, part_at, parts_of
from kalmap.slam.contours.stacked import Constraint, Solved, Stacked, condition, in_first_frame
from kalmap.slam.contours.stretches import Noise, Stretch, on_one_curve, shared_stretches
from kalmap.slam.contours.thinning import thinned

SCALE = 4.0  # how much wider, in variance, the maps' errors may be than their covariances say
LIMITS = (0.3, 0.15, 0.1)  # m, how far apart samples and contour may lie in the rounds of association
AGREEMENT, BESIDE = 0.75, 20  # share of the overlap that must agree afterwards, where it has so many points
AGREES = 0.08  # m
SETTLED = 1e-4  # m and rad, of the linearisation
MOST_ROUNDS = 10


class Joined(msgspec.Struct, frozen=True, eq=False):
    """What a join came to. map: None if it was refused, and why.

    corners, stretches: how many were shared. distance: squared, of all constraints, and its degrees of freedom.
    agreement: of the overlap afterwards, None where there is none. pose, pose_covariance: (3,) T_first_second
    and its (3, 3). laid: both maps, each in its own frame, as they were corrected.
    """

    map: ClosedMap | None
    why: str
    corners: int
    stretches: int
    distance: float
    freedom: int
    agreement: float | None
    pose: np.ndarray
    pose_covariance: np.ndarray
    laid: tuple[ClosedMap, ClosedMap]


def join_contours(first: ClosedMap, second: ClosedMap, noise: Noise = "curve") -> ClosedMap | None:
    """The joined map in the first's frame, its end the second's; None where the two contradict each other.

    Complete as published: corners of both maps that are one are forced equal without noise; samples of both on one
    contour are given one curve of low order and their signed distances from it as virtual measurements of 0, with the
    noise of `kalmap.slam.contours.stretches.on_one_curve` ("zero" is the paper's); one block update; the second map is
    moved into the first's frame; crowded samples are put onto their curve and thinned. Maps that share nothing are
    chained. A join is refused when the constraints' joint distance is beyond chance, even with errors twice what the
    maps say, or when less than three quarters of the overlap agree afterwards.
    """
    return joined(first, second, noise).map


def joined(first: ClosedMap, second: ClosedMap, noise: Noise = "curve") -> Joined:
    """`join_contours`, with what it found."""
    stacked = Stacked(first, second)
    association = Association(first, second, stacked, noise)
    association.run()
    solved, corners, stretches = association.solved, association.corners, association.stretches
    limit = SCALE * chi_square(0.999, solved.freedom) if solved.freedom else 0.0
    laid = (
        msgspec.structs.replace(first, mean=solved.mean[: stacked.start]),
        msgspec.structs.replace(second, mean=solved.mean[stacked.start :]),
    )
    pose = solved.mean[:3].copy()
    spread = stacked.covariance[:3, :3] - solved.gain[:, :3].T @ solved.gain[:, :3]
    agreement = overlap_agreement(*laid, pose)
    facts = (len(corners), len(stretches), solved.distance, solved.freedom, agreement, pose, spread, laid)
    if solved.distance > limit:
        return Joined(None, f"joint distance {solved.distance:.0f} of {solved.freedom} numbers", *facts)
    if agreement is not None and agreement < AGREEMENT:
        return Joined(None, f"only {agreement:.0%} of the overlap agrees", *facts)
    covariance = solved.covariance(stacked.covariance)
    mean, covariance = in_first_frame(stacked, solved.mean, covariance)
    union = ClosedMap(
        mean,
        covariance,
        np.concatenate([first.normals, rotate(solved.mean[2], second.normals)]),
        np.concatenate([first.sightings, second.sightings]),
        first.spacing,
    )
    return Joined(thinned(union, stretches), "", *facts)


class Association:
    """Which corners and which stretches two maps share, found in rounds; the estimate is made anew from the prior in
    each, so that nothing is used twice."""

    def __init__(self, first: ClosedMap, second: ClosedMap, stacked: Stacked, noise: Noise) -> None:
        self.first, self.second, self.stacked, self.noise = first, second, stacked, noise
        self.solved = Solved(stacked.mean.copy(), 0.0, 0, np.zeros((0, len(stacked.mean))))
        self.corners: list[tuple[int, int]] = []
        self.stretches: list[Stretch] = []
        self._found = corners_of(first), corners_of(second)

    def run(self) -> None:
        """Corners and what is surely placed first, then part after part, the surest first; then closer and closer."""
        self._match_corners()
        self._solve()
        waiting = parts_of(self.second)
        while waiting:
            at = [part_at(self.stacked, self.solved, rows, SCALE)[0] for rows in waiting]
            sure = [rows for rows, part in zip(waiting, at, strict=True) if part.is_sure]
            if sure:
                self._take(np.concatenate(sure), self.solved.mean[:3])
                waiting = [rows for rows, part in zip(waiting, at, strict=True) if not part.is_sure]
                continue
            rows = waiting.pop(int(np.argmin([part.sigma for part in at])))
            place = look_for(self.first, self.second, self.stacked, self.solved, rows, SCALE)
            if place is not None:
                self._take(rows, place)
        for limit in LIMITS[1:]:
            self.stretches = self._shared(limit)
            self._match_corners()
            self._solve()
        for _ in range(MOST_ROUNDS):
            before = self.solved.mean
            self._solve()
            if np.abs(self.solved.mean - before).max() < SETTLED:
                break

    def _take(self, rows: np.ndarray, T_first_second: np.ndarray) -> None:
        """Use what some of the second map's samples share with the first, the map being placed so."""
        more = self._shared(LIMITS[0], rows, T_first_second)
        if more:
            self.stretches = [*self.stretches, *more]
            self._solve()

    def _match_corners(self) -> None:
        self.corners = match_corners(self.stacked, self.solved.mean, *self._found, SCALE)

    def _shared(
        self, limit: float, rows: np.ndarray | None = None, T_first_second: np.ndarray | None = None
    ) -> list[Stretch]:
        """Stretches that are shared, of some rows of the second map only, or with it placed elsewhere."""
        mean = self.solved.mean
        pose = mean[:3] if T_first_second is None else T_first_second
        places = pose[:2] + rotate(pose[2], self.stacked.second(mean))
        if rows is not None:
            left = np.setdiff1d(np.arange(len(places)), rows)
            places[left] = np.nan
        normals = rotate(pose[2], self.second.normals)
        samples = self.stacked.first(mean)
        found = shared_stretches(self.first, self.second, samples, places, normals, limit)
        return [each for each in found if self._fits(each)]

    def _fits(self, stretch: Stretch) -> bool:
        """Whether chance may have brought the samples so far off one curve, as much as is known by now."""
        made = on_one_curve(self.stacked, self.solved.mean, stretch, "curve")
        if not len(made.value):
            return False
        spread = SCALE * self.solved.spread(self.stacked.covariance, made.matrix) + made.noise
        squared = float(made.value @ np.linalg.solve(spread, made.value))
        return squared <= chi_square(0.999, len(made.value))

    def _constraints(self, mean: np.ndarray) -> list[Constraint]:
        ones, others = self._found
        made = [same_corner(self.stacked, mean, ones[i], others[j]) for i, j in self.corners]
        return made + [on_one_curve(self.stacked, mean, each, self.noise) for each in self.stretches]

    def _solve(self, rounds: int = 2) -> None:
        for _ in range(rounds):
            mean = self.solved.mean
            self.solved = condition(self.stacked.mean, self.stacked.covariance, self._constraints(mean), mean)


def overlap_agreement(first: ClosedMap, second: ClosedMap, pose: np.ndarray) -> float | None:
    """Of the second's contours that lie beside the first's, the share that lies on them; None if hardly any do."""
    a, b = Shape.of(first), Shape.of(second)
    beside, offsets = np.full(len(b.points), -1, dtype=np.int64), np.zeros(len(b.points))
    matched, near, _ = correlate.align_points(
        pose.copy(), b.points, b.point_normals, a.segments, a.normals, a.nearest, a.low, CELL,
        np.array([AGREES, AGREES]), 1, 0.02, beside, offsets,
    )  # fmt: skip
    return matched / near if near >= BESIDE else None
