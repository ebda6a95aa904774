"""Large worlds: the choice of near features, events made on the way, and what a large lawn costs."""

import pickle
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from kalmap.records import Odometry, Sightings
from kalmap.simulate import sense, simulate, world_by_name
from kalmap.simulate.sense import visible


def dense(poses, landmarks, max_range, min_range):
    """Slow twin: every pose with every feature, one after the other."""
    found = []
    for f, (x, y, heading) in enumerate(poses):
        dx, dy = landmarks[:, 0] - x, landmarks[:, 1] - y
        squared = dx * dx + dy * dy
        ahead = dx * np.cos(heading) + dy * np.sin(heading) > 0
        for n in np.flatnonzero((squared >= min_range**2) & (squared < max_range**2) & ahead):
            found.append((f, n, np.hypot(dx[n], dy[n])))
    return np.array(found).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("max_range", [0.5, 7.0, 1e4])
def test_near_features_are_those_of_every_pair(seed, max_range, monkeypatch):
    """Oracle: `dense`. Poses inside and far outside the features' box, also exactly on features and squares."""
    monkeypatch.setattr(sense, "_PAIRS", 3000)
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-30, 40, (2000, 2))
    landmarks[:40] = np.rint(landmarks[:40])
    poses = np.column_stack([rng.uniform(-60, 80, (150, 2)), rng.uniform(-3, 3, 150)])
    poses[:20, :2] = landmarks[:20] + [max_range, 0.0]
    poses[20:40, :2] = landmarks[20:40]
    poses[40, :2] = 1e9
    frame, feature, values = visible(poses, landmarks, max_range, 180.0, 0.3)
    expected = dense(poses, landmarks, max_range, 0.3)
    np.testing.assert_array_equal(np.column_stack([frame, feature]), expected[:, :2])
    np.testing.assert_array_equal(values[:, 0], expected[:, 2])
    assert len(expected) > 3


def test_no_features_or_no_poses():
    for poses, landmarks in ((np.zeros((3, 3)), np.zeros((0, 2))), (np.zeros((0, 3)), np.zeros((4, 2)))):
        frame, feature, values = visible(poses, landmarks, 30.0, 180.0)
        assert len(frame) == len(feature) == 0 and values.shape == (0, 2)
    one = visible(np.zeros((1, 3)), np.array([[1.0, 0.0]]), 1e-3 + 1.0, 180.0)
    assert one[1].tolist() == [0]


def test_events_are_made_on_the_way_and_again():
    log = simulate(world_by_name("lawn-300"), 1)
    first, second = list(log), list(pickle.loads(pickle.dumps(log)))
    for a, b in zip(first, second, strict=True):
        assert type(a) is type(b) and (a.time, a.record) == (b.time, b.record)
        np.testing.assert_array_equal(a.values, b.values)
    steps = sum(len(event.values) for event in first if isinstance(event, Odometry))
    assert steps == len(log.references[0].times) - 1
    tracemalloc.start()
    for event in log:
        del event
    assert tracemalloc.get_traced_memory()[1] < 2e6  # all events together hold ten times that
    tracemalloc.stop()


@pytest.mark.parametrize("n", [3_000, 12_000])
def test_a_large_lawn_shows_its_landmarks_and_each_look_tries_the_near_ones_only(n):
    """One landmark to 250 m^2: nine squares of 30 m hold 32 of them, whatever the size of the lawn."""
    world = world_by_name(f"lawn-{n}")
    poses = simulate(world, 1).references[0].positions[8::8]
    tried = sum(len(frame) for frame, _ in sense._near_pairs(poses, world.landmarks, world.max_range))
    assert 20 < tried / len(poses) < 40
    frames = [event.ids for event in simulate(world, 1) if isinstance(event, Sightings)]
    assert len(np.unique(np.concatenate(frames))) > 0.98 * n


_HUGE = """
import resource
import time
from kalmap.simulate import simulate, world_by_name
log = simulate(world_by_name("lawn-100000"), 1)
assert sum(1 for _ in log) > 2_000_000
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in kilobytes on Linux only")
def test_a_hundred_thousand_landmarks_fit_in_two_gigabytes():
    out = subprocess.run(
        [sys.executable, "-c", _HUGE], capture_output=True, text=True, timeout=900, check=True
    )
    kilobytes, seconds = out.stdout.split()
    assert int(kilobytes) < 2_000_000
    assert float(seconds) < 120.0  # 30 s of the processor
