"""The frames of the closed maps as a sparse least-squares problem: what each map says of the next, and the loops."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, rotate
from kalmap.slam.contours.spread import Spread, spread_of


class Relation(msgspec.Struct, frozen=True):
    """T_first_second (3,) between the frames of two closed maps, measured with its information (3, 3).

    information: by what the maps say of themselves, before the graph scales it.
    loop: whether it was found by laying maps over each other, and may be wrong.
    """

    first: int
    second: int
    pose: np.ndarray
    information: np.ndarray
    loop: bool = False


class _Measured(msgspec.Struct, frozen=True, eq=False):
    """All R relations as arrays: first, second (R,), pose (R, 3), information (R, 3, 3) with the graph's scale.

    share: (R,) see `FrameGraph._shares`. rows, columns: where their blocks stand in the information of frames 1 to n,
    entry by entry; free: which entries, frame 0 being known.
    """

    first: np.ndarray
    second: np.ndarray
    pose: np.ndarray
    information: np.ndarray
    share: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    free: np.ndarray


CAUCHY = 12.0  # squared distance at which a relation has half its weight: one in a hundred is beyond


class FrameGraph:
    """Frames (n, 3) in the map; the first one is the map's own. Solved by Gauss-Newton, outliers weighed down.

    The frames take all relations at their word; their covariance does not take loops for independent that rest on the
    same map, see `_shares`. scale: factor on the covariances of all relations.
    """

    def __init__(self) -> None:
        self.frames = np.zeros((1, 3))
        self.scale = 1.0
        self.relations: list[Relation] = []
        self._spread: Spread | None = None

    def append(self, step: np.ndarray, covariance: np.ndarray) -> None:
        """A further frame, from what the last map says of its end."""
        self.frames = np.concatenate([self.frames, compose(self.frames[-1], step)[None]])
        count = len(self.frames)
        self.relations.append(Relation(count - 2, count - 1, step.copy(), np.linalg.inv(covariance)))
        self._spread = None

    def rescale(self, scale: float) -> None:
        """Another scale of all relations, those of before as well."""
        self.scale = scale
        self._spread = None

    def replace(self, relations: list[Relation]) -> None:
        """Other relations between the same frames."""
        self.relations = relations
        self._spread = None

    def add(self, relation: Relation) -> None:
        """A loop."""
        self.relations.append(relation)
        self._spread = None

    def copy(self) -> FrameGraph:
        """A graph of its own in the same state."""
        other = FrameGraph()
        other.frames, other.relations, other.scale = self.frames.copy(), list(self.relations), self.scale
        return other

    def solve(self, rounds: int = 10, tolerance: float = 1e-7, robust: bool = True) -> None:
        """Move the frames to where the relations want them; one alone, or none, stays where it is.

        robust: whether relations that are far off are weighed down, which holds frames that have far to go.
        """
        if len(self.frames) < 2:
            return
        measured = self._measured()
        for _ in range(rounds):
            values, right = self._normal(measured, independent=True, robust=robust)
            step = spread_of(measured.rows, measured.columns, values, len(right)).solve(right).reshape(-1, 3)
            self.frames[1:] += step
            self.frames[:, 2] = wrap(self.frames[:, 2])
            if np.abs(step).max(initial=0.0) < tolerance:
                break
        self._spread = None

    def _measured(self) -> _Measured:
        first = np.array([r.first for r in self.relations], dtype=np.int64)
        second = np.array([r.second for r in self.relations], dtype=np.int64)
        rows, columns = [], []
        for p in (first, second):
            for q in (first, second):
                there = np.broadcast_arrays(_entries(p)[:, :, None], _entries(q)[:, None, :])
                rows.append(there[0].ravel())
                columns.append(there[1].ravel())
        down, across = np.concatenate(rows) - 3, np.concatenate(columns) - 3
        free = (down >= 0) & (across >= 0)
        return _Measured(
            first,
            second,
            np.array([r.pose for r in self.relations]).reshape(-1, 3),
            np.array([r.information for r in self.relations]).reshape(-1, 3, 3) / self.scale,
            self._shares(first, second),
            down[free],
            across[free],
            free,
        )

    def _linearised(self, measured: _Measured) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (R, 3) and their derivatives by the first and the second frames (R, 3, 3)."""
        a, b = self.frames[measured.first], self.frames[measured.second]
        way = rotate(-a[:, 2], b[:, :2] - a[:, :2])
        off = measured.pose
        residual = np.column_stack([way - off[:, :2], wrap(b[:, 2] - a[:, 2] - off[:, 2])])
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        by_second = np.zeros((len(a), 3, 3))
        by_second[:, 0, 0], by_second[:, 0, 1], by_second[:, 1, 0], by_second[:, 1, 1] = c, s, -s, c
        by_second[:, 2, 2] = 1.0
        by_first = -by_second
        by_first[:, 0, 2], by_first[:, 1, 2] = way[:, 1], -way[:, 0]
        return residual, by_first, by_second

    def distances(self) -> np.ndarray:
        """(R,) squared Mahalanobis distance of every relation from where the frames are, each by itself."""
        measured = self._measured()
        residual, _, _ = self._linearised(measured)
        return np.einsum("ri,rij,rj->r", residual, measured.information, residual)

    def _shares(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(R,) weights by which loops that rest on one map's samples count as one together.

        How a map is bent shows in all of them, so that they err alike: by the more used of its two maps, each gets an
        equal part (a covariance intersection). What follows the drive is measured afresh by every map.
        """
        far = np.array([r.loop for r in self.relations], dtype=bool) & (second > first + 1)
        count = len(self.frames)
        used = np.bincount(first[far], minlength=count) + np.bincount(second[far], minlength=count)
        return np.where(far, 1.0 / np.maximum(1, np.maximum(used[first], used[second])), 1.0)

    def _normal(
        self, measured: _Measured, independent: bool, robust: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of all frames but the first: the matrix's entries, which add up, and the right side."""
        residual, by_first, by_second = self._linearised(measured)
        squared = np.einsum("ri,rij,rj->r", residual, measured.information, residual)
        weight = 1.0 / (1.0 + squared / CAUCHY) if robust else np.ones(len(squared))
        if not independent:
            weight *= measured.share
        weighed = measured.information * weight[:, None, None]
        right = np.zeros(3 * len(self.frames))
        blocks = []
        for p, by_p in ((measured.first, by_first), (measured.second, by_second)):
            half = np.swapaxes(by_p, 1, 2) @ weighed
            np.subtract.at(right, _entries(p), np.einsum("rij,rj->ri", half, residual))
            blocks += [(half @ by_first).ravel(), (half @ by_second).ravel()]
        return np.concatenate(blocks)[measured.free], right[3:]

    def spread(self) -> Spread:
        """The covariance of the frames, of which there must be two at least."""
        if self._spread is None:
            measured = self._measured()
            values, right = self._normal(measured, independent=False)
            self._spread = spread_of(measured.rows, measured.columns, values, len(right))
        return self._spread

    def own_covariances(self) -> np.ndarray:
        """(n, 3, 3) of every frame; the first one is known."""
        return self.spread().own() if len(self.frames) > 1 else np.zeros((1, 3, 3))

    def covariance(self) -> np.ndarray:
        """(3 n, 3 n) of all frames: O(n^2), for a few."""
        count = len(self.frames)
        whole = np.zeros((count, 3, count, 3))
        for second in range(1, count):
            for first in range(1, count):
                whole[first, :, second] = self.spread().block(first, second)
        return whole.reshape(3 * count, 3 * count)

    def between(self, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
        """T_first_second (3,) as it is thought to be, and its covariance (3, 3)."""
        poses, covariances = self.from_each([first], second)
        return poses[0], covariances[0]

    def from_each(self, first: list[int], second: int) -> tuple[np.ndarray, np.ndarray]:
        """T_first_second (K, 3) from each of K frames to one, and their covariances (K, 3, 3)."""
        a, b = self.frames[first], self.frames[second]
        way = rotate(-a[:, 2], b[:2] - a[:, :2])
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        design = np.zeros((len(a), 3, 6))
        design[:, 0, 0], design[:, 0, 1], design[:, 1, 0], design[:, 1, 1] = -c, -s, s, -c
        design[:, :2, 3:5] = -design[:, :2, :2]
        design[:, 0, 2], design[:, 1, 2] = way[:, 1], -way[:, 0]
        design[:, 2, 2], design[:, 2, 5] = -1.0, 1.0
        block = np.zeros((len(a), 6, 6))
        for row, frame in enumerate(first):
            if frame == second:
                continue
            spread = self.spread()
            across = spread.block(frame, second)
            block[row, :3, :3], block[row, 3:, 3:] = spread.block(frame, frame), spread.block(second, second)
            block[row, :3, 3:], block[row, 3:, :3] = across, across.T
        poses = np.column_stack([way, wrap(b[2] - a[:, 2])])
        return poses, design @ block @ np.swapaxes(design, 1, 2)


def _entries(frames: np.ndarray) -> np.ndarray:
    """(R, 3), where the numbers of frames (R,) stand in those of all."""
    return 3 * frames[:, None] + np.arange(3)


def beside_the_end(end: np.ndarray, found: np.ndarray, with_end: np.ndarray) -> np.ndarray:
    """Information (3, 3) that an overlay of a map by the next one adds to what the first map says of its own end.

    end, found: (3, 3) covariances of the two; with_end: (3, 3) of the overlay's error (rows) with the end's. Both come
    from one map's scans and err alike: together they know no more than the best linear estimate from both.
    """
    joint = np.block([[end, with_end.T], [with_end, found]])
    both = np.vstack([np.eye(3), np.eye(3)])
    added = both.T @ np.linalg.solve(joint, both) - np.linalg.inv(end)
    values, vectors = np.linalg.eigh(0.5 * (added + added.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
