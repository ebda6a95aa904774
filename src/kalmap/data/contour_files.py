"""A contour map as other programs read it: a table of its samples, and GeoJSON with a line for each run."""

from __future__ import annotations

import numpy as np

from kalmap.data.files import csv_text, json_text
from kalmap.records import Contours

COLUMNS = ("run", "x", "y", "p_xx", "p_xy", "p_yy", "nx", "ny", "sightings")


def contours_csv(contours: Contours) -> str:
    """One row a sample, runs one after the other and each in its own order; m and m^2."""
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *contours.strands()])
    covariances = contours.covariances.reshape(-1, 4)[:, [0, 1, 3]]
    numbers = np.column_stack([contours.positions, covariances, contours.normals])[rows].tolist()
    runs, sightings = contours.runs[rows].tolist(), contours.sightings[rows].tolist()
    return csv_text(
        COLUMNS, ([run, *row, seen] for run, row, seen in zip(runs, numbers, sightings, strict=True))
    )


def contours_geojson(contours: Contours, time: float) -> str:
    """A FeatureCollection in local metres, which it says: RFC 7946 itself would mean WGS84.

    A run is a LineString, a sample that is alone a Point; the properties hold a list with one entry a sample of
    covariances, normals and sightings.
    """
    return json_text(
        {
            "type": "FeatureCollection",
            "coordinates_frame": "local metres",
            "time": time,
            "features": [_feature(contours, rows) for rows in contours.strands()],
        }
    )


def _feature(contours: Contours, rows: np.ndarray) -> dict[str, object]:
    places = contours.positions[rows].tolist()
    line = len(rows) > 1
    return {
        "type": "Feature",
        "id": int(contours.runs[rows[0]]),
        "geometry": {"type": "LineString" if line else "Point", "coordinates": places if line else places[0]},
        "properties": {
            "covariances": contours.covariances[rows].tolist(),
            "normals": contours.normals[rows].tolist(),
            "sightings": contours.sightings[rows].tolist(),
        },
    }
