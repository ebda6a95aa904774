"""What disturbs a simulated sensor: clutter, misses, doubles and movers, each against its own statistics."""

import math

import msgspec
import numpy as np
import pytest
from scipy import stats

from kalmap.geometry.angles import wrap
from kalmap.records import ConfigError, Odometry
from kalmap.simulate import World, mover_tracks, sense, simulate, world_by_name
from kalmap.simulate.sense import visible
from simulated_logs import by_identity, flat, frames, looks

# what the first release simulated: control samples, sightings, and sums over them weighted with cos(0), cos(1), ...
# of speed, steering, range, bearing and id (weighted, so that order counts; no hash, which would hang on last digits)
BEFORE = {
    ("course-35", 1): (
        16845,
        3047,
        [18.4676659750, 0.2778514087, 182.3476409371, 6.2588062003, -103.3111067253],
    ),
    ("course-70", 7): (
        16845,
        6139,
        [68.7692293231, 11.5257099608, 78.2995859657, -6.4889810467, 344.2304094878],
    ),
    ("same-50", 1): (
        16845,
        2879,
        [18.4676659750, 0.2778514087, 101.6488500091, -3.1366127898, -97.1305339731],
    ),
    ("wide-40", 1): (18007, 2166, [12.5270620302, -0.7636810493, 8.6064823054, 2.3198814088, -52.8447775005]),
    ("lawn-40", 7): (6183, 2173, [2.0884956118, -1.0902605680, 201.8509769094, 2.7835038406, 211.8073630545]),
}
OPEN = World(name="open", landmarks=np.array([[500.0, 0.0]]), waypoints=np.array([[60.0, 0.0]]), laps=1)


def inside(share, probability, count):
    """Whether a share of so many trials is within 99.9 % of that probability."""
    return abs(share - probability) < 3.3 * math.sqrt(probability * (1 - probability) / count)


@pytest.mark.parametrize("name_seed", BEFORE, ids=str)
def test_worlds_without_disturbances_are_what_they_were(name_seed):
    """Oracle: numbers taken before the disturbances came in."""
    log = simulate(world_by_name(name_seed[0]), name_seed[1])
    controls = np.concatenate([event.values for event in log if isinstance(event, Odometry)])
    _, ids, values = flat(log)
    columns = [*controls.T, *values.T, ids]
    sums = [float(np.cos(np.arange(len(column))) @ column) for column in columns]
    assert (len(controls), len(ids)) == BEFORE[name_seed][:2]
    np.testing.assert_allclose(sums, BEFORE[name_seed][2], rtol=0, atol=1e-7)


def test_clutter_is_poisson_and_uniform():
    """Oracle: chi-square against scipy's Poisson distribution, Kolmogorov-Smirnov against the uniform one."""
    world = world_by_name("clutter-5")
    number, ids, values = flat(simulate(world, 1))
    false = ids < 0
    counts = np.bincount(number[false], minlength=len(looks(world)))
    bins = np.bincount(np.minimum(counts, 12), minlength=13)
    expected = len(counts) * np.append(stats.poisson.pmf(np.arange(12), 5.0), stats.poisson.sf(11, 5.0))
    assert stats.chisquare(bins, expected).pvalue > 0.01
    assert stats.chisquare(bins, np.roll(expected, 1)).pvalue < 1e-6
    for column, low, width in ((0, 0.0, 30.0), (1, -np.pi / 2, np.pi)):
        assert stats.kstest(values[false, column], "uniform", (low, width)).pvalue > 0.01


def test_clutter_fills_the_field_of_view_there_is():
    _, ids, values = flat(simulate(msgspec.structs.replace(OPEN, clutter=20.0, field_of_view_deg=300.0), 1))
    assert (ids < 0).all() and len(ids) > 1500
    assert np.degrees(np.abs(values[:, 1])).max() == pytest.approx(150.0, abs=1.0)


def test_worlds_that_differ_in_their_disturbances_share_everything_else():
    plain = world_by_name("course-35")
    log = simulate(plain, 5)
    changes = {"clutter": 5.0, "movers": 20, "doubles": 0.0, "detection_probability": 1.0}
    for field in ("clutter", "movers"):
        other = simulate(msgspec.structs.replace(plain, **{field: changes[field]}), 5)
        np.testing.assert_array_equal(by_identity(log), by_identity(other))
        assert (flat(other)[1] < 0).sum() > 50
        for mine, theirs in zip(log, other, strict=True):
            if isinstance(mine, Odometry):
                np.testing.assert_array_equal(mine.values, theirs.values)
    all_of_it = msgspec.structs.replace(plain, clutter=5.0, movers=20, doubles=0.5, detection_probability=0.7)
    kept = {tuple(row) for row in by_identity(log)}
    hard, missed = by_identity(simulate(all_of_it, 5)), by_identity(simulate(world_by_name("missed-35"), 5))
    assert {tuple(row) for row in missed} == {tuple(row) for row in hard} & kept


def test_a_share_of_the_features_is_missed_each_frame_by_itself():
    """Oracle: the binomial distribution; and the sightings of the same world without misses."""
    whole, left = (by_identity(simulate(world_by_name(name), 2)) for name in ("course-35", "missed-35"))
    assert {tuple(row) for row in left} < {tuple(row) for row in whole}
    seen = np.isin(whole[:, 0] * 100 + whole[:, 1], left[:, 0] * 100 + left[:, 1])
    assert inside(seen.mean(), 0.7, len(seen))
    order = np.lexsort((whole[:, 0], whole[:, 1]))  # one feature's sightings after the other, in time
    assert abs(np.corrcoef(seen[order][1:], seen[order][:-1])[0, 1]) < 3.3 / math.sqrt(len(seen))


def test_doubles_have_noise_of_their_own():
    """Oracle: the binomial distribution; two independent normal errors differ by sqrt(2) sigma."""
    world = world_by_name("doubles-35")
    rows = by_identity(simulate(world, 2))
    _, first, count = np.unique(rows[:, :2], axis=0, return_index=True, return_counts=True)
    assert set(count.tolist()) == {1, 2}
    assert inside((count == 2).mean(), 0.2, len(count))
    twice = first[count == 2]
    apart = rows[twice + 1, 2:] - rows[twice, 2:]
    expected = math.sqrt(2.0) * np.array([0.1, math.radians(1.0)])
    np.testing.assert_allclose(np.sqrt((apart**2).mean(axis=0)), expected, rtol=0.1)
    plain = by_identity(simulate(world_by_name("course-35"), 2))
    assert {tuple(row) for row in plain} < {tuple(row) for row in rows}


def test_what_moves_is_looked_at_in_pieces_too(monkeypatch):
    """Oracle: the same in one piece."""
    poses, rng = looks(OPEN), np.random.default_rng(1)
    points = poses[:, None, :2] + rng.uniform(-40.0, 40.0, (len(poses), 7, 2))
    whole = visible(poses, points, 30.0, 180.0)
    monkeypatch.setattr(sense, "_PAIRS", 50)
    for mine, same in zip(visible(poses, points, 30.0, 180.0), whole, strict=True):
        np.testing.assert_array_equal(mine, same)
    assert len(whole[0]) > 100


def test_the_order_in_a_frame_tells_nothing():
    """Oracle: in a random order the mean place, from 0 to 1, is a half, and two of M stand together in 2 / M."""
    number, ids, _ = flat(simulate(world_by_name("breaker"), 1))
    size = np.bincount(number)
    place = (np.arange(len(number)) - np.searchsorted(number, number) + 0.5) / size[number]
    for group in (ids < 0, ids >= 0, ids > 200):
        assert abs(place[group].mean() - 0.5) < 3.3 / math.sqrt(12 * group.sum())
    assert abs(stats.spearmanr(place[ids >= 0], ids[ids >= 0]).statistic) < 3.3 / math.sqrt((ids >= 0).sum())
    beside = (ids[1:] == ids[:-1]) & (ids[1:] >= 0) & (number[1:] == number[:-1])
    _, at, count = np.unique(
        np.column_stack([number, ids])[ids >= 0], axis=0, return_index=True, return_counts=True
    )
    chance = 2.0 / size[number[ids >= 0][at[count == 2]]]
    assert beside.sum() == pytest.approx(chance.sum(), abs=4 * math.sqrt(chance.sum()))


def test_movers_keep_their_pace_and_their_box():
    """Oracle: the distance walked from frame to frame, where nobody was mirrored."""
    world = world_by_name("djnn-50")
    tracks = mover_tracks(world, 1, 685)
    low, high = world.landmarks.min(axis=0), world.landmarks.max(axis=0)
    assert tracks.shape == (685, 50, 2)
    assert (tracks >= low).all() and (tracks <= high).all()
    steps = np.diff(tracks, axis=0)
    inner = ((tracks[:-1] > low + 0.3) & (tracks[:-1] < high - 0.3)).all(axis=-1)
    np.testing.assert_allclose(np.hypot(*steps[inner].T), 1.4 * 0.2, atol=1e-9)
    assert np.hypot(steps[..., 0], steps[..., 1]).max() <= 1.4 * 0.2 + 1e-9
    heading = np.arctan2(steps[..., 1], steps[..., 0])
    turn = wrap(np.diff(heading, axis=0))[inner[:-1] & inner[1:]]
    assert math.degrees(turn.std()) == pytest.approx(15.0 * math.sqrt(0.2), rel=0.03)
    assert (np.ptp(tracks, axis=0).max(axis=1) > 20.0).mean() > 0.9


def test_movers_start_anywhere_by_the_seed_and_more_movers_are_others_besides():
    world = world_by_name("djnn-50")
    tracks = mover_tracks(world, 1, 685)
    np.testing.assert_array_equal(tracks, mover_tracks(world, 1, 685))
    np.testing.assert_array_equal(tracks[:, :10], mover_tracks(world_by_name("djnn-10"), 1, 685))
    starts = np.concatenate([mover_tracks(world, seed, 1)[0] for seed in range(8)])
    low, high = world.landmarks.min(axis=0), world.landmarks.max(axis=0)
    for column in (0, 1):
        share = (starts[:, column] - low[column]) / (high - low)[column]
        assert stats.kstest(share, "uniform").pvalue > 0.01


def test_movers_are_sighted_like_features():
    """Oracle: a loop over frames and movers."""
    world = msgspec.structs.replace(
        world_by_name("djnn-50"), max_range=20.0, sigma_range=1e-6, sigma_bearing_deg=1e-4
    )
    seen, poses = frames(simulate(world, 2)), looks(world)
    tracks = mover_tracks(world, 2, len(poses))
    for number in range(0, len(poses), 20):
        x, y, heading = poses[number]
        expected = []
        for u, v in tracks[number] - (x, y):
            if math.hypot(u, v) < 20.0 and u * math.cos(heading) + v * math.sin(heading) > 0:
                expected.append((math.hypot(u, v), wrap(math.atan2(v, u) - heading)))
        found = seen[number].values[seen[number].ids < 0]
        np.testing.assert_allclose(
            found[np.argsort(found[:, 0])], np.array(sorted(expected)).reshape(-1, 2), atol=1e-4
        )
    missed = flat(simulate(msgspec.structs.replace(world, detection_probability=0.7), 2))[1]
    count = (flat(simulate(world, 2))[1] < 0).sum()
    assert inside((missed < 0).sum() / count, 0.7, count)


@pytest.mark.parametrize(
    "landmarks", [np.zeros((0, 2)), np.array([[30.0, 0.0]]), np.array([[5.0, 0.0], [55.0, 0.0]])]
)
def test_movers_find_room_where_features_span_none(landmarks):
    world = msgspec.structs.replace(OPEN, landmarks=landmarks, movers=4)
    tracks = mover_tracks(world, 1, 500)
    assert np.isfinite(tracks).all()
    assert (np.ptp(tracks, axis=(0, 1)) > 10.0).all() and (np.ptp(tracks, axis=(0, 1)) <= 50.0).all()
    assert mover_tracks(world, 1, 0).shape == (0, 4, 2)
    assert (flat(simulate(world, 1))[1] < 0).sum() > 0


def test_nothing_is_seen_and_everything_twice():
    world = msgspec.structs.replace(OPEN, landmarks=np.array([[60.0, 3.0]]))
    blind = simulate(msgspec.structs.replace(world, detection_probability=0.0, doubles=1.0), 1)
    assert all(frame.values.shape == (0, 2) for frame in frames(blind))
    twice = [len(frame.ids) for frame in frames(simulate(msgspec.structs.replace(world, doubles=1.0), 1))]
    assert set(twice) == {0, 2}


TRUNKS = {"scanner": "sick", "radii": np.array([0.2])}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"movers": -1}, "movers must be a whole number"),
        ({"movers": 1.5}, "movers must be a whole number"),
        ({"movers": 20_000}, "movers must be at most 10000"),
        ({"mover_speed": 0.0}, "mover_speed must be positive"),
        ({"mover_speed": math.nan}, "mover_speed must be positive"),
        ({"mover_radius": math.inf}, "mover_radius must be positive"),
        ({"clutter": -0.1}, "clutter must be zero or more"),
        ({"clutter": math.nan}, "clutter must be zero or more"),
        ({"clutter": 1e6}, "clutter must be at most 1000"),
        ({"clutter": 10**400}, "clutter must be zero or more"),
        ({"detection_probability": 1.1}, "detection_probability must be a probability"),
        ({"detection_probability": math.nan}, "detection_probability must be a probability"),
        ({"doubles": -0.2}, "doubles must be a probability"),
        ({"sigma_beam": -0.01}, "sigma_beam must be zero or more"),
        ({"scanner": "radar"}, "unknown scanner 'radar'; known are sick, urg"),
        ({"scanner": "sick"}, "a scanner needs the radii"),
        ({"radii": np.array([0.2, 0.2])}, r"radii must be one to a landmark \(1\)"),
        ({"radii": np.array([0.0])}, "radii must be finite and positive"),
        ({"radii": np.array([math.nan])}, "radii must be finite and positive"),
        ({**TRUNKS, "clutter": 1.0}, ".*a scanner has none of them"),
        ({**TRUNKS, "doubles": 0.5}, ".*a scanner has none of them"),
        ({**TRUNKS, "detection_probability": 0.9}, ".*a scanner has none of them"),
        ({**TRUNKS, "max_range": 81.0}, "max_range must be at most the scanner's 80 m"),
        ({**TRUNKS, "field_of_view_deg": 270.0}, "field_of_view_deg must be at most the scanner's 180"),
    ],
)
def test_a_disturbance_that_cannot_be_is_refused(change, problem):
    with pytest.raises(ConfigError, match=f"world open: {problem}"):
        msgspec.structs.replace(OPEN, **change)
