"""Poles with reflective tape, from the intensities that a laser scanner reports."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.records import EventError, Scan, Sightings


class ReflectorDetector(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Groups neighbouring reflective beams; each group is one pole.

    A beam is reflective if its intensity is above `threshold` and its range is a return between
    `min_range` and `max_range`. Beams belong to one group if at most `missing_beams` others lie between
    them and their ranges differ by at most `max_step`. The pole's centre is at the mean bearing of its
    beams and `radius` behind the mean of their ranges. A group needs `min_beams` beams.

    The car park's poles, 6 cm wide, are measured 7 mm too far on average with `radius` 0, so that is the
    default: scanner and pole have a bias of the size of the radius.

    Lengths in m. The attributes of its sightings are "reflectivity", the highest intensity in the
    scanner's own units, and "beams", how many beams hit the pole.
    """

    threshold: float = 0.0
    min_range: float = 0.5
    max_range: float = 80.0
    missing_beams: int = 1
    max_step: float = 0.5
    radius: float = 0.0
    min_beams: int = 1

    def __call__(self, scan: Scan) -> Sightings:
        """The poles in a scan, from right to left. Raises `EventError` if it has no intensities."""
        bits = _intensities(scan)
        ranges = np.asarray(scan.ranges, dtype=np.float64)
        # Comparisons with NaN are false, so a beam without a number is never a reflector.
        hits = np.flatnonzero((bits > self.threshold) & (ranges > self.min_range) & (ranges < self.max_range))
        if not len(hits):
            return _sightings(scan, np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        near = ranges[hits]
        apart = (np.diff(hits) > self.missing_beams + 1) | (np.abs(np.diff(near)) > self.max_step)
        first = np.concatenate([[0], np.flatnonzero(apart) + 1])
        beams = np.diff(np.append(first, len(hits)))
        centre = np.add.reduceat(near, first) / beams + self.radius
        bearing = np.add.reduceat(np.asarray(scan.bearings)[hits], first) / beams
        brightest = np.maximum.reduceat(bits[hits], first)
        kept = beams >= self.min_beams
        values = np.column_stack([centre, bearing])[kept]
        return _sightings(scan, values, brightest[kept], beams[kept].astype(np.float64))


def _intensities(scan: Scan) -> np.ndarray:
    """The scan's intensities (B,), if it has one for every beam."""
    if scan.intensities is None:
        raise EventError("the scan has none: reflectors cannot be told", time=scan.time, field="intensities")
    bits = np.asarray(scan.intensities, dtype=np.float64)
    sizes = (len(bits), len(scan.ranges), len(scan.bearings))
    if len(set(sizes)) != 1:
        problem = "{} intensities, {} ranges and {} bearings: expected as many".format(*sizes)
        raise EventError(problem, time=scan.time, field="intensities")
    return bits


def _sightings(scan: Scan, values: np.ndarray, reflectivity: np.ndarray, beams: np.ndarray) -> Sightings:
    attributes = {"reflectivity": reflectivity, "beams": beams}
    return Sightings(scan.time, values, attributes=attributes, scan=scan, record=scan.record)
