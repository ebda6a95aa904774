"""ACFR car park: the Victoria Park car among 15 surveyed reflective poles, 125 s.

Variants: `sightings` (each scan handed to a detector of reflectors) and `scans` (raw). The surveyed poles
are in the frame of the GPS fixes, so one reference holds both.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from kalmap.data import ute
from kalmap.data.blocks import Detector, StreamEvents
from kalmap.data.mat import load_mat, matrix, vector
from kalmap.data.streams import FixStream, ScanStream, Streams
from kalmap.data.victoria_park import fix_stream, gps_reference, held
from kalmap.records import Log, LogError

VARIANTS = ("sightings", "scans")
POLE_RANGE = 16.0
"""m: the scanner sees farther, but no reflector comes back stronger from beyond this."""

DATA, POLES = "data_set.mat", "beac_juan3.mat"


def open_car_park(path: Path, variant: str | None, detector: Detector | None) -> Log:
    """The log whose data file is `path`. Without a detector both variants yield the scans themselves."""
    variant = variant or "sightings"
    if variant not in VARIANTS:
        raise LogError(f"no variant {variant!r}; there are {', '.join(VARIANTS)}", file=path.parent)
    poles_path = path.with_name(POLES)
    poles = None
    if poles_path.is_file():
        poles = matrix(load_mat(poles_path, ("estbeac",)), "estbeac", poles_path, columns=2)
    fixes = _fixes(path)
    car = ute.defaults(ute.POLES, "reflectors", identified=False)
    return Log(
        name="car-park",
        source=str(path.parent),
        defaults=msgspec.structs.replace(
            car, sensor=msgspec.structs.replace(car.sensor, max_range=POLE_RANGE)
        ),
        open=StreamEvents(lambda: _streams(path), detector if variant == "sightings" else None),
        references=(gps_reference(fixes, poles),),
        files=(str(path),),
    )


def _fixes(path: Path) -> FixStream:
    variables = load_mat(path, ("TimeGPS", "GPSLon", "GPSLat"))
    times = vector(variables, "TimeGPS", path)
    east, north = (vector(variables, name, path, len(times)) for name in ("GPSLon", "GPSLat"))
    return fix_stream(path, times, east, north)


def _streams(path: Path) -> Streams:
    names = ("Time_VS", "Velocity", "Steering", "TimeLaser", "Laser", "Intensity")
    variables = load_mat(path, names)
    times = vector(variables, "Time_VS", path)
    columns = [vector(variables, name, path, len(times)) for name in ("Velocity", "Steering")]
    stamps = vector(variables, "TimeLaser", path)
    ranges = matrix(variables, "Laser", path, rows=len(stamps), columns=ute.BEAMS)
    intensities = matrix(variables, "Intensity", path, rows=len(stamps), columns=ute.BEAMS)
    scans = ScanStream(
        file=str(path),
        times=stamps,
        records=np.arange(1, len(stamps) + 1),
        ranges=ute.returns(ranges),
        bearings=ute.BEAM_BEARINGS,
        intensities=intensities,
    )
    return Streams(odometry=held(path, times, columns), scans=scans, fixes=_fixes(path))
