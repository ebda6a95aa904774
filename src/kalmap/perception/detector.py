"""What finds landmarks in a laser scan."""

from __future__ import annotations

from typing import Protocol

from kalmap.records import Scan, Sightings


class Detector(Protocol):
    """Turns one scan into the landmarks seen in it, at the same time and in the same sensor frame.

    A scan in which nothing is found gives a `Sightings` of no rows. Raises `EventError` for a scan
    that lacks what the detector looks at.
    """

    def __call__(self, scan: Scan) -> Sightings: ...
