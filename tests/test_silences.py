"""Silences of an odometry beside scans, by hand: which scans are left out, and that it is told."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.data.drive import Drive, outside_silences, silence_notes
from kalmap.data.odometry_gaps import Silence, silences


def driven(stamps, *quiet):
    count = len(stamps)
    beams = [np.linspace(-1.0, 1.0, 5)] * count
    return outside_silences(
        Drive(
            file="bag", stamps=np.array(stamps), records=np.arange(1, count + 1), poses=np.zeros((count, 3)),
            ranges=[np.ones(5)] * count, bearings=beams,
            silences=tuple(Silence(begin, end, 0, count - 1) for begin, end in quiet),
        )
    )  # fmt: skip


@pytest.mark.parametrize(
    ("quiet", "left_out", "told"),
    [
        ((2.2, 4.8), [3, 4], True),
        ((7.5, 9.9), [8, 9], True),  # until after the last scan
        ((-1.0, 1.5), [0, 1], True),  # from before the first
        ((2.2, 2.8), [], True),  # between two scans
        ((20.0, 25.0), [], False),  # after them all
    ],
)
def test_scans_inside_a_silence_are_left_out_and_told(quiet, left_out, told):
    drive = driven(np.arange(10.0), quiet)
    assert sorted(drive.left_out) == left_out
    assert bool(silence_notes(drive)) == told


def test_a_silence_is_longer_than_a_second_and_than_usual():
    times = np.array([0.0, 0.1, 0.2, 1.1, 1.2, 3.0, 3.1])
    assert [(each.begin, each.end) for each in silences(times, 0, 6)] == [(1.2, 3.0)]
    assert silences(3.0 * np.arange(5.0), 0, 4) == ()
