"""The local map that a drive is in: pose and contour samples as one Gaussian, corrected by every scan that is used."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.gaussian import Belief, NotPositiveError
from kalmap.gaussian.belief import packed_places
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import rotate
from kalmap.kernels import contour as kernel
from kalmap.kernels import contour_state as state
from kalmap.kernels.contour_noise import fill_noise
from kalmap.kernels.layout import BIAS_COUNT, OK
from kalmap.kernels.packed import pack
from kalmap.perception.contours import Pieces
from kalmap.records import Odometry
from kalmap.slam.contours.belief import squared_distance
from kalmap.slam.contours.late import check_samples
from kalmap.slam.contours.seen import Calibration, Rules, Seen
from kalmap.slam.contours.wheels import factors, moved_by_scales

ROUNDS = 15  # of the pose's fit to a scan, at most
FIRST_LIMIT, LAST_LIMIT = (
    0.5,
    0.15,
)  # m, how far from a curve a sample may lie in the first round and in the last
OPEN_SCANS = 3  # scans in a row that look through a sample before it is retired
TRUSTED_SHARE = 0.5  # of what scans find as a rule of the samples in view, below which one is tried elsewhere
FAR = 25.0  # squared distance from the odometry's place beyond which a scan's place, or the odometry, is doubted
NEAR_LIMIT = 0.08  # m, how far from a curve a sample may lie where the odometry is believed
SMALL = np.diag([1e-6, 1e-6, 1e-7])  # what no odometry is better than
FORGET = 0.05  # a scan's part in what is the rule
LEAST_IN_VIEW = 10  # samples
BETTER = 1.5  # how many times better another place must be
SURE_FOUND = 25  # samples that it must find: people stand about, too
SLIPPED_SHARE, JUMPED_SHARE = 0.7, 0.8  # of those in view: of the usual share for a slip, of all for a jump
SLIP = np.array([0.3, 0.3, 0.3])  # m, m, rad, of wheels; beyond it the odometry must have jumped
SLIPPED, JUMPED = 1.3, 2.0  # how many times larger the share must be there
TURNS = np.radians(5.0) * np.array([side * step for step in range(1, 17) for side in (1, -1)])
ASTRAY = np.diag([0.5**2, 0.5**2, 0.1**2])
SAGITTA = 0.01  # m, how far a contour may bend away from the line between two samples
PUNCTUAL = np.zeros(3)  # no latency can change the way
OUTLIER = 3.0  # standard deviations beyond which a distance has its noise inflated
LEARN, LEARN_FULL = 0.05, 20  # a scan's part in the noise's factor, and from how many distances on
MOST_NIS, MOST_FACTOR = 4.0, 25.0  # of one scan, a distance; of the noise
UNKNOWN = 0.5  # of a scale's variance before the drive, above which nothing has been learnt of it
_WHEELS = np.array([state.WHEELS, state.WHEELS + 1])
_POSE_AND_WHEELS = packed_places(np.concatenate([np.arange(3), _WHEELS]))


class LiveMap:
    """One local map in the making. Its frame is the vehicle's pose at its start, which it knows exactly.

    normals: (N, 2) of the samples, towards the free side. sightings, open: (N,) scans that corrected each, and scans in
    a row that looked through it. length: m driven. scans: used. usual: share of the samples in
    view that scans find as a rule. noise: by how much the variance of the scans' distances is more than their fits say,
    as their innovations have shown. earlier: local maps of the same drive before this one. nis, used: of the last scan.
    """

    def __init__(
        self, rules: Rules, calibration: Calibration | None = None, noise: float = 1.0, earlier: int = 0
    ) -> None:
        self.rules = rules
        self.belief = _begun(np.zeros(3), calibration or rules.calibration)
        self._setup = rules.engine.setup.copy()
        self._setup[BIAS_COUNT] = state.SAMPLES - 3  # the calibration is not turned with the map
        self._since = _begun(np.zeros(3), self.calibration)
        self._last_pose = np.zeros(3)  # the pose after the last scan that was used
        self.normals = np.zeros((0, 2))
        self.sightings = np.zeros(0, dtype=np.int64)
        self.open = np.zeros(0, dtype=np.int64)
        self.length, self.scans, self.usual = 0.0, 0, 1.0
        self.noise, self.earlier = noise, earlier
        self.nis, self.used = float("nan"), 0

    @property
    def calibration(self) -> Calibration:
        """What is known of the vehicle now."""
        entries = np.arange(state.CALIBRATION, state.SAMPLES)
        return Calibration(self.belief.mean[entries], self.belief.block(entries))

    @property
    def scales(self) -> np.ndarray:
        """(3,) by which odometry's increments (forward, left, turn) are multiplied."""
        return factors(self.belief.mean[state.WHEELS : state.WHEELS + 2])

    @property
    def count(self) -> int:
        """How many samples the map holds."""
        return len(self.normals)

    @property
    def pose(self) -> np.ndarray:
        """(3,) in the local frame; a copy."""
        return self.belief.mean[:3].copy()

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3); a copy."""
        return _moved(self.belief, self._of_wheels(self.belief.mean[:3]))

    @property
    def driven(self) -> np.ndarray:
        """(2, 2) m^2, what the odometry since the last scan that was used has added to the place's covariance."""
        return self._prior(self.belief.mean[:3])[:2, :2]

    @property
    def end_covariance(self) -> np.ndarray:
        """(3, 3) of the pose as the end of a closed map, which adds to those of the maps before as if independent.

        What the wheels' scales are wrong by is wrong in all of them: with K maps before, the variance that this adds to
        the sum is 1 + 2 K times its own share, or a drive would seem surer the more maps it is parted into. Only while
        scans have said next to nothing of a scale, as along a bare corridor: what is left of it later is small.
        """
        spread = self.belief.packed[_POSE_AND_WHEELS]
        unknown = np.diagonal(spread)[3:] > UNKNOWN * self.rules.sigma_wheels**2
        across = spread[:3, 3:][:, unknown]
        shared = across @ np.linalg.solve(spread[3:, 3:][np.ix_(unknown, unknown)], across.T)
        return np.asarray(self.pose_covariance + 2.0 * self.earlier * shared)

    def map(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (3 + 2 N,) and covariance of pose and samples as they are closed, the calibration left out."""
        kept = np.concatenate([np.arange(3), np.arange(state.SAMPLES, self.belief.n)])
        covariance = self.belief.covariance()[np.ix_(kept, kept)]
        covariance[:3, :3] = self.end_covariance
        return self.belief.mean[kept], covariance

    @property
    def samples(self) -> np.ndarray:
        """(N, 2) m; a copy."""
        return self.belief.mean[state.SAMPLES : self.belief.n].reshape(-1, 2).copy()

    def predict(self, event: Odometry, late: np.ndarray = PUNCTUAL) -> None:
        """Odometry: equations (5) and (6). Raises BadSampleError before anything is changed.

        late: (3,) m, m, rad, how a second more of latency would change the event's way, see `late.moved`.
        """
        check_samples(event)
        if self.rules.sigma_wheels.any():
            scales = self.scales
            event, late = msgspec.structs.replace(event, values=event.values * scales), scales * late
        blamed = late.any()
        before = self.belief.mean[:2].copy()
        for belief in (self.belief, self._since):
            state.shift_point(belief.mean, belief.packed, belief.n, 1.0)
            heading = belief.mean[2]
            self.rules.engine.predict(belief, event)
            belief.flush()
            if blamed:
                effect = np.array([*rotate(heading, late[:2]), late[2]])
                state.blame(belief.packed, belief.n, state.LATENCY, effect)
            state.shift_point(belief.mean, belief.packed, belief.n, -1.0)
        self.length += float(np.hypot(*(self.belief.mean[:2] - before)))

    def observe(self, seen: Seen, stray: np.ndarray = PUNCTUAL) -> None:
        """A scan: correct by the samples that it shows, found samples where it shows more, retire what is gone.

        stray: (3,) m, m, rad in the vehicle's frame, standard deviation of where the scan was taken along the way,
        since no stamp is exact.
        """
        self.nis, self.used = float("nan"), 0
        self.scans += 1
        if self.count and len(seen.pieces):
            self._correct(seen, stray)
        else:
            self._blame_wheels(self.belief.mean[:3])
        if len(seen.pieces):
            self._found(seen, stray)
        self._since = _begun(self.belief.mean[:3], self.calibration)
        self._last_pose = self.belief.mean[:3].copy()
        self._retire()

    def fit(self, seen: Seen, pose: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a scan fits the samples best. prior: (3, 3) covariance of `pose`.

        Where few of the samples in view are found there, the odometry may have jumped: then the scan is tried all
        around, and goes where clearly more of them are found. Returns the pose (3,) and what became of each sample
        (N,): its piece, or HIDDEN, OPEN, ASIDE.
        """
        fitted, found = self.place(seen, pose, prior)
        # beyond that the odometry lies, or the scan is on the wrong samples
        if squared_distance(fitted, pose, prior + SMALL) > FAR:
            near, there = self.place(seen, pose, prior, NEAR_LIMIT)
            if BETTER * _value(there) >= _value(found):
                fitted, found = near, there
        share = _share(found)
        if share >= TRUSTED_SHARE * self.usual or (found != kernel.HIDDEN).sum() < LEAST_IN_VIEW:
            return fitted, found
        best, before, first = BETTER * _value(found), share, fitted
        for turn in TURNS:
            start = np.array([pose[0], pose[1], pose[2] + turn])
            other, there = self.place(seen, start, ASTRAY)
            value, share = _value(there), _share(there)
            if value <= best or (there >= 0).sum() < SURE_FOUND:
                continue
            move = other - first
            move[2] = wrap(move[2])
            slipped = bool((np.abs(move) < SLIP).all())
            if slipped:
                least = max(SLIPPED_SHARE * self.usual, SLIPPED * before)
            else:
                least = max(JUMPED_SHARE, JUMPED * before)
            if share >= least:
                best, fitted, found = value, other, there
        return fitted, found

    def place(
        self, seen: Seen, pose: np.ndarray, prior: np.ndarray, limit: float = LAST_LIMIT
    ) -> tuple[np.ndarray, np.ndarray]:
        """The fit that begins at one pose: the pose (3,) and what became of each sample (N,). See `fit`."""
        fitted, information = pose.copy(), np.linalg.inv(prior + SMALL)
        found, distances = np.empty(self.count, dtype=np.int64), np.empty(self.count)
        pieces = seen.pieces
        stray = 3.0 * math.sqrt(max(prior[0, 0], prior[1, 1]) + prior[2, 2] * _reach(pieces.points) ** 2)
        first = min(FIRST_LIMIT, limit + (stray if limit == LAST_LIMIT else 0.0))
        kernel.fit_pose(
            fitted, information, self.samples, self.normals, self.rules.mount, seen.bearings, seen.ranges,
            seen.piece_of_beam, pieces.coef, pieces.origin, pieces.scale, seen.sigma, self.rules.reach,
            np.array([first, limit]), ROUNDS, found, distances, np.empty((self.count, 2)),
        )  # fmt: skip
        fitted[2] = wrap(fitted[2])
        return fitted, found

    def _correct(self, seen: Seen, stray: np.ndarray) -> None:
        """Equations (7) to (11), with the distances' derivatives taken where the scan fits the samples."""
        belief, pieces = self.belief, seen.pieces
        turned = np.array([*rotate(belief.mean[2], stray[:2]), stray[2]])
        prior = self._prior(belief.mean[:3]) + np.outer(turned, turned)
        fitted, found = self.fit(seen, belief.mean[:3], prior)
        slipped = squared_distance(fitted, belief.mean[:3], prior + SMALL) > FAR
        self._blame_wheels(belief.mean[:3] if slipped else fitted)
        if slipped:  # for which neither a latency is to blame nor the wheels' scales
            for entry in (state.LATENCY, *_WHEELS):
                state.acquit(belief.packed, belief.n, entry)
        self.open = np.where(found == kernel.OPEN, self.open + 1, np.where(found >= 0, 0, self.open))
        self.usual += FORGET * (_share(found) - self.usual)
        rows = np.flatnonzero(found >= 0)
        if not len(rows):
            return
        indices, piece = state.SAMPLES + 2 * rows, found[rows]
        at = belief.mean.copy()  # the derivatives are taken where the scan fits best
        at[:3] = fitted
        matrices, distances = np.empty((len(rows), 7)), np.empty(len(rows))
        residuals = np.empty(len(rows))
        status = kernel.regress_distances(
            self._setup, at, belief.packed, self.rules.mount, indices, piece, pieces.coef, pieces.origin, pieces.scale,
            matrices, distances, residuals,
        )  # fmt: skip
        self._face(rows, at, indices, matrices)
        moved = belief.mean[:3] - at[:3]
        moved[2] = wrap(moved[2])
        innovation = -distances - matrices[:, :3] @ moved
        noise = self._noise(pieces, piece, _turned_back(at, belief.mean[indices[:, None] + np.arange(2)]))
        if stray.any():
            late = matrices[:, :3] @ turned
            noise += np.outer(late, late)
        excess = np.maximum(0.0, (distances / OUTLIER) ** 2 - np.diagonal(noise)) + residuals
        noise[np.diag_indices(len(rows))] += excess
        left, right = belief.work(2 * len(rows))
        if status == OK:
            status, self.nis = state.apply_distances(
                self._setup,
                belief.mean,
                belief.packed,
                belief.n,
                indices,
                matrices,
                innovation,
                noise,
                left,
                right,
            )
        if status != OK:
            raise NotPositiveError("the covariance of a local map is not positive definite")
        self.used = len(rows)
        if not slipped:
            self._learn()
        self.sightings[rows] += 1

    def _of_wheels(self, pose: np.ndarray) -> np.ndarray:
        """(2, 3) by what a unit of each scale has moved the vehicle from the last scan to `pose`."""
        if not self.rules.sigma_wheels.any():
            return np.zeros((2, 3))
        mean = self.belief.mean
        scales, lever = mean[state.WHEELS : state.WHEELS + 2], mean[state.LEVER : state.LEVER + 2]
        return moved_by_scales(scales, lever, self._last_pose, pose)

    def _prior(self, pose: np.ndarray) -> np.ndarray:
        """(3, 3) covariance of the way from the last scan to `pose`, by odometry."""
        return _moved(self._since, self._of_wheels(pose))

    def _blame_wheels(self, pose: np.ndarray) -> None:
        """Give the pose its share of the scales' errors, the way to it being that to `pose`."""
        belief = self.belief
        belief.flush()
        for entry, row in zip(_WHEELS, self._of_wheels(pose), strict=True):
            if row.any():
                state.blame(belief.packed, belief.n, entry, row)

    def _learn(self) -> None:
        """Take the scans for noisier where their distances lie farther off than they should, and the other way round:
        much of what stands in rooms is no smooth wall. Never for better than their fits say."""
        surplus = min(self.nis / self.used, MOST_NIS) - 1.0
        factor = self.noise * (1.0 + LEARN * min(1.0, self.used / LEARN_FULL) * surplus)
        self.noise = min(MOST_FACTOR, max(1.0, factor))

    def _face(self, rows: np.ndarray, at: np.ndarray, indices: np.ndarray, matrices: np.ndarray) -> None:
        """Take the distances' derivatives along the normals that the scans before have shown, not as this one has them.

        The noise of one scan's normal stands in the derivative as if it were known: squared, it seems to hold the
        vehicle along its walls (Fuller 1987, Measurement Error Models, section 1.1); and it is the noise of the
        distance, too, with which it must have nothing to do. Normals of many scans err less, and alike every time.
        """
        seen, weight = matrices[:, 5:7], self.sightings[rows, None]
        steep = np.hypot(*seen.T)[:, None]
        before = self.normals[rows]
        mean = weight * before + seen / steep
        self.normals[rows] = mean / np.hypot(*mean.T)[:, None]
        change = steep * before - seen
        away = at[indices[:, None] + np.arange(2)] - at[:2]
        matrices[:, 5:7] += change
        matrices[:, :2] -= change
        matrices[:, 2] += change[:, 0] * away[:, 1] - change[:, 1] * away[:, 0]
        effect = np.empty((len(rows), 2))
        state.calibration_effect(
            rotate(-at[2], away), rotate(-at[2], steep * before), self.rules.mount, effect
        )
        matrices[:, 3:5] = -effect

    def _noise(self, pieces: Pieces, piece: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(M, M) m^2, covariance of the distances of `points` (M, 2), in the robot's frame, from their curves.

        Points on one curve share its uncertainty; each has the contour's roughness of its own. A scan is not quite
        what the curves' own covariance says: it is taken while the vehicle moves, and walls reflect unevenly.
        """
        noise, settings = np.empty((len(points), len(points))), self.rules.contour
        fill_noise(
            points, piece, pieces.coef, pieces.cov, pieces.origin, pieces.scale, pieces.sigma, pieces.ends,
            pieces.lengths, settings.sigma_offset**2, math.radians(settings.sigma_askew_deg) ** 2, noise,
        )  # fmt: skip
        return noise * self.noise

    def _found(self, seen: Seen, stray: np.ndarray) -> None:
        """New samples where the scan shows contour that no sample stands for.

        Not where it is seen at a grazing angle: what a fit is wrong by there, in its bend or its normal, is nearly the
        same in the next scans, which then seem to hold the vehicle along the wall or push it on.
        """
        belief, pieces = self.belief, seen.pieces
        spacing = np.minimum(self.rules.contour.spacing, _spacing_by_bend(pieces))
        hits = len(pieces.points)
        new, normal, piece = np.empty((hits, 2)), np.empty((hits, 2)), np.empty(hits, dtype=np.int64)
        count = kernel.uncovered(
            belief.mean[:3], pieces.points, pieces.piece, self.rules.mount, self.rules.steepest, pieces.coef,
            pieces.origin, pieces.scale, spacing, self.samples, self.normals, new, normal, piece,
        )  # fmt: skip
        if not count:
            return
        new, normal, piece = new[:count], normal[:count], piece[:count]
        belief.flush()
        belief.reserve(belief.n + 2 * count)
        noise = self._noise(pieces, piece, new)
        if stray.any():
            late = normal @ stray[:2] + stray[2] * (normal[:, 1] * new[:, 0] - normal[:, 0] * new[:, 1])
            noise += np.outer(late, late)
        effect = np.empty((count, 2))
        state.calibration_effect(new, normal, self.rules.mount, effect)
        belief.n = state.append_samples(belief.mean, belief.packed, belief.n, new, normal, effect, noise)
        self.normals = np.concatenate([self.normals, rotate(belief.mean[2], normal)])
        self.sightings = np.concatenate([self.sightings, np.ones(count, dtype=np.int64)])
        self.open = np.concatenate([self.open, np.zeros(count, dtype=np.int64)])

    def _retire(self) -> None:
        """Marginalise out the samples that scans look through: what stood there is gone, or never stood still."""
        gone = np.flatnonzero((self.open >= OPEN_SCANS) & (self.open > self.sightings))
        if not len(gone):
            return
        for row in gone[::-1]:
            self.belief.remove(state.SAMPLES + 2 * int(row), 2)
        self.normals = np.delete(self.normals, gone, axis=0)
        self.sightings, self.open = np.delete(self.sightings, gone), np.delete(self.open, gone)


def _moved(belief: Belief, rows: np.ndarray) -> np.ndarray:
    """(3, 3) of a belief's pose after its wheels' scales have moved it by rows (2, 3) a unit."""
    spread = belief.packed[_POSE_AND_WHEELS]
    across = spread[:3, 3:] @ rows
    return np.asarray(spread[:3, :3] + across + across.T + rows.T @ spread[3:, 3:] @ rows)


def _reach(points: np.ndarray) -> float:
    """m, within which nine in ten of a scan's points (N, 2) lie; np.percentile takes as long as the scan's fit."""
    if not len(points):
        return 0.0
    distances = np.sort(np.hypot(points[:, 0], points[:, 1]))
    row, share = divmod(0.9 * (len(distances) - 1), 1.0)
    below, above = distances[int(row)], distances[min(int(row) + 1, len(distances) - 1)]
    return float(below + share * (above - below))


def _value(found: np.ndarray) -> float:
    """How much speaks for a place: the samples found there, the less the more are missed."""
    return float((found >= 0).sum()) * _share(found)


def _begun(pose: np.ndarray, calibration: Calibration) -> Belief:
    """A belief of a pose (3,) that is known exactly and of the calibration."""
    belief = Belief(pose, np.zeros((3, 3)))
    whole = np.zeros((state.SAMPLES, state.SAMPLES))
    whole[3:, 3:] = calibration.covariance
    belief.reserve(state.SAMPLES)
    belief.mean[3 : state.SAMPLES] = calibration.mean
    pack(whole, state.SAMPLES, belief.packed)
    belief.n = state.SAMPLES
    return belief


def _share(found: np.ndarray) -> float:
    """Of the samples in view, the share that a scan finds."""
    return float((found >= 0).sum() / max(1, (found != kernel.HIDDEN).sum()))


def _turned_back(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(M, 2) points of the map in the robot's frame."""
    return np.ascontiguousarray(rotate(-pose[2], points - pose[:2]))


def _spacing_by_bend(pieces: Pieces) -> np.ndarray:
    """(K,) m: samples are so far apart that the contour between them is off their chord by `SAGITTA`."""
    chords = np.hypot(*(pieces.ends[:, 1] - pieces.ends[:, 0]).T)
    # of an arc of length l over a chord c, the radius is about sqrt(l^3 / (24 (l - c)))
    excess = np.maximum(pieces.lengths - chords, 1e-9)
    radius = np.sqrt(pieces.lengths**3 / (24.0 * excess))
    return np.maximum(0.05, np.sqrt(8.0 * SAGITTA * np.maximum(radius, 0.03)))
