"""What local maps work by, and a scan made ready for one: calibrated, undistorted, cut into pieces."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.gaussian import Lineariser
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.kernels.implicit import distance_rows
from kalmap.models import Increments, RangeBearing
from kalmap.models.motion import BuiltInMotion
from kalmap.perception.contours import CutConfig, Pieces, cut_scan
from kalmap.records import ConfigError, ContourConfig, Scan, SensorConfig
from kalmap.slam.contours import wheels
from kalmap.slam.engines import CompiledEngine


class Calibration(msgspec.Struct, frozen=True):
    """What is known of the vehicle: mean (7,) and covariance (7, 7) of bearing scale, range offset m, lever x, y m,
    latency s and the scales of the wheels' ways and turns.

    A bearing b truly is (1 + scale) b, a range r truly is r + offset. The lever is where the point that the odometry
    speaks of is in the vehicle's frame, to which the scanner is fixed as its settings say. The latency is how much
    later than it was taken, by the odometry's clock, a scan is stamped. A way or a turn that odometry tells truly is
    (1 + scale) times as long.
    """

    mean: np.ndarray
    covariance: np.ndarray


LATENCY_DRIFT = 0.01
"""s, by how much a latency is another one a local map later: clocks drift."""
LATENCY_BIAS = 0.02
"""s, by how much it comes out too long on simulated floors of 0 to 0.15 s: odometry is noisy, and so are the speeds
taken from it, by the same noise that the latency is asked to explain (errors in variables)."""


def later(calibration: Calibration) -> Calibration:
    """What is known of the vehicle when a new local map begins."""
    covariance = calibration.covariance.copy()
    drift = np.array([LATENCY_DRIFT, *wheels.DRIFT])
    covariance[[4, 5, 6], [4, 5, 6]] += np.where(np.diagonal(covariance)[4:] > 0.0, drift**2, 0.0)
    return Calibration(calibration.mean, covariance)


class Rules(msgspec.Struct, frozen=True):
    """What every local map of a drive works by. sigma_wheels: (2,) of the scales of odometry's ways
    and turns."""

    engine: CompiledEngine
    sensor: SensorConfig
    contour: ContourConfig
    cut: CutConfig
    sigma_wheels: np.ndarray

    @property
    def calibration(self) -> Calibration:
        """What is known of the vehicle before the drive."""
        contour = self.contour
        sigmas = [
            contour.sigma_bearing_scale,
            contour.sigma_range_offset,
            contour.sigma_lever,
            contour.sigma_lever,
            contour.sigma_latency,
            *self.sigma_wheels,
        ]
        return Calibration(np.zeros(7), np.diag(sigmas) ** 2)

    @property
    def reach(self) -> np.ndarray:
        """(2,) m, how far the scanner sees, and up to where its silence says that nothing is there."""
        return np.array([self.sensor.max_range, min(self.sensor.max_range, self.contour.clear_range)])

    @property
    def steepest(self) -> float:
        """Sine of the least angle between a beam and a contour at which a sample is put there."""
        return math.sin(math.radians(self.cut.grazing_deg))

    @property
    def mount(self) -> np.ndarray:
        """(3,) the scanner on the vehicle."""
        sensor = self.sensor
        return np.array([sensor.mount_x, sensor.mount_y, math.radians(sensor.mount_heading_deg)])


def rules_of(
    motion: BuiltInMotion,
    lineariser: Lineariser,
    coordinates: str,
    sensor: SensorConfig,
    contour: ContourConfig,
) -> Rules:
    """The rules by which local maps are made, from the settings of a run. Raises ConfigError for a latency without
    odometry of increments."""
    if contour.sigma_latency and not isinstance(motion, Increments):
        raise ConfigError("contour.sigma_latency: a latency is estimated with odometry of increments only")
    engine = CompiledEngine(motion, RangeBearing(), lineariser, coordinates == "invariant", False)
    sigmas = np.array([contour.sigma_way_scale, contour.sigma_turn_scale]) * isinstance(motion, Increments)
    return Rules(engine, sensor, contour, CutConfig(), sigmas)


class Seen(msgspec.Struct, frozen=True):
    """A scan, cut and ready to be laid beside samples: the pieces, and what the kernels read of the beams.

    sigma: (K,) m, of distances from each piece: its roughness, and its curve's uncertainty at its ends.
    """

    scan: Scan
    pieces: Pieces
    bearings: np.ndarray
    ranges: np.ndarray
    piece_of_beam: np.ndarray
    sigma: np.ndarray


def prepare(scan: Scan, rules: Rules, calibration: np.ndarray, twist: np.ndarray) -> Seen:
    """Cut a scan into pieces; its beams in ascending order of bearing, which the pieces' numbers keep.

    calibration: bearing scale and range offset m, which are taken out, and more. twist: (3,) m/s, m/s, rad/s of the
    vehicle, by which the beams were taken from different places.
    """
    scan = undistorted(
        calibrated(scan, calibration, rules.sensor), twist, rules.mount, rules.sensor.beam_time
    )
    pieces = cut_scan(scan, rules.sensor, rules.cut)
    piece_of_beam = np.full(len(scan.bearings), -1, dtype=np.int64)
    piece_of_beam[pieces.beam] = pieces.piece
    bearings = np.ascontiguousarray(wrap(np.asarray(scan.bearings, dtype=float)))
    ranges = np.asarray(scan.ranges, dtype=float)
    ranges = np.where(ranges > rules.sensor.min_range, ranges, np.inf)  # NaN and zero too: nothing came back
    order = np.argsort(bearings, kind="stable")
    order = order[np.isfinite(bearings[order])]
    return Seen(scan, pieces, bearings[order], ranges[order], piece_of_beam[order], _deviations(pieces))


def calibrated(scan: Scan, calibration: np.ndarray, sensor: SensorConfig) -> Scan:
    """The scan without the scanner's bearing scale and range offset, the first two of `calibration`.

    What is no range of the scanner's becomes +inf before it is shifted: NaN, what is too near, and what is too far.
    """
    raw = np.asarray(scan.ranges, dtype=float)
    measured = (raw > sensor.min_range) & (raw < sensor.max_range)
    bearings = np.asarray(scan.bearings, dtype=float) * (1.0 + calibration[0])
    return msgspec.structs.replace(
        scan, bearings=bearings, ranges=np.where(measured, raw + calibration[1], np.inf)
    )


def undistorted(scan: Scan, twist: np.ndarray, mount: np.ndarray, beam_time: float) -> Scan:
    """The scan as it would be if all its beams had been taken where the middle one was.

    beam_time: s from each beam to the next, in the order of the scan. Over one sweep the vehicle's speed is constant.
    """
    if not beam_time or not twist.any():
        return scan
    after = beam_time * (np.arange(len(scan.ranges)) - 0.5 * (len(scan.ranges) - 1))
    way = after[:, None] * twist
    there = compose(way, np.broadcast_to(mount, way.shape))
    back = compose(inverse(mount), there)
    heading = back[:, 2] + scan.bearings
    finite = np.where(np.isfinite(scan.ranges), scan.ranges, 1.0)
    x, y = back[:, 0] + finite * np.cos(heading), back[:, 1] + finite * np.sin(heading)
    bearings = np.where(np.isfinite(scan.ranges), np.arctan2(y, x), heading)
    return msgspec.structs.replace(
        scan, bearings=bearings, ranges=np.where(np.isfinite(scan.ranges), np.hypot(x, y), scan.ranges)
    )


def _deviations(pieces: Pieces) -> np.ndarray:
    """(K,) m, see `Seen`."""
    rows = np.empty((len(pieces), 2, 1, 10))  # of either end
    for k, ((ox, oy), scale) in enumerate(zip(pieces.origin.tolist(), pieces.scale.tolist(), strict=True)):
        distance_rows(pieces.coef[k], ox, oy, scale, pieces.ends[k], rows[k, :, 0])
    of_curves = rows @ pieces.cov[:, None] @ np.swapaxes(rows, 2, 3)
    return np.asarray(np.sqrt(pieces.sigma**2 + of_curves.max(axis=(1, 2, 3))))
