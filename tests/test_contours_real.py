"""Pieces of the real building logs: how much of them becomes contour. Skipped where the logs are not."""

from __future__ import annotations

import lzma

import numpy as np
import pytest

from kalmap.perception import cut_scan
from kalmap.records import Scan, SensorConfig
from real_data import data_root  # noqa: F401

BEARINGS = np.deg2rad(np.arange(180) - 90.0)
LOGS = [("intel-lab/intel.clf.xz", 80.0), ("aces/aces.clf.xz", 49.9)]


def every_tenth_scan(path):
    """Ranges (180,) of every tenth FLASER line."""
    rows = []
    with lzma.open(path, "rt") as lines:
        for line in lines:
            if line.startswith("FLASER 180 "):
                rows.append(line)
    return [np.array(row.split()[2:182], dtype=float) for row in rows[::10]]


@pytest.mark.parametrize(("name", "reach"), LOGS)
def test_most_beams_of_a_building_end_on_a_piece(request, name, reach):
    """Above 85 % of the valid beams, misfits of the size of a SICK's noise, walls seen whole."""
    path = request.getfixturevalue("data_root") / name
    if not path.exists():
        pytest.skip(f"no real data: {path} does not exist")
    sensor = SensorConfig(sigma_range=0.015, max_range=reach)
    valid, used, residuals, longest = 0, 0, [], []
    for ranges in every_tenth_scan(path):
        pieces = cut_scan(Scan(0.0, ranges, BEARINGS), sensor)
        valid, used = valid + len(pieces.piece), used + int((pieces.piece >= 0).sum())
        assert np.isfinite(pieces.coef).all() and np.isfinite(pieces.cov).all()
        for k in range(len(pieces)):
            away = pieces.curve(k).distance(pieces.points[pieces.piece == k])
            residuals.append(away)
            points = pieces.points[pieces.piece == k]
            middle = pieces.curve(k).project(points[len(points) // 2])
            assert pieces.curve(k).gradient(middle) @ -middle > 0.0 or pieces.order[k] > 1
        longest.append(pieces.lengths.max(initial=0.0))
    assert used > 0.85 * valid
    assert np.sqrt(np.mean(np.concatenate(residuals) ** 2)) < 0.02
    assert np.median(longest) > 2.0
