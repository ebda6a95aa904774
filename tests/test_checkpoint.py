"""A saved filter goes on bit for bit; a damaged or foreign file is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from damage import cuts, flipped, refused_cuts
from kalmap.association import (
    Attribute,
    Counter,
    Djnn,
    Existence,
    Jcbb,
    KnownIds,
    Likelihood,
    Merging,
    Nearest,
    Region,
    Trial,
)
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import ConfigError, LogError, Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.checkpoint import FORMAT
from slam_problems import LINEARISERS, STEERING_BIASES, XYSensor, circle_events, feed, state_of

EVENTS = circle_events(4, frames=16)

COMBINATIONS = [
    *[
        (name, "reduced", c, u)
        for name in LINEARISERS
        for c in ("additive", "invariant")
        for u in ("joint", "sequential")
    ],
    *[
        (name, "full", c, "joint")
        for name in ("central", "unscented", "cubature")
        for c in ("additive", "invariant")
    ],
]


def assert_goes_on(slam, path, events, stop):
    """Save after `stop` events, load, feed both the rest: bit for bit the same as never stopping."""
    feed(slam, events[:stop])
    slam.save(path)
    resumed = LandmarkSlam.load(path)
    assert state_of(resumed) == state_of(slam)
    feed(slam, events[stop:])
    feed(resumed, events[stop:])
    assert state_of(resumed) == state_of(slam)
    return resumed


@pytest.mark.parametrize(("name", "scope", "coordinates", "use"), COMBINATIONS)
def test_resumed_run_is_the_same_bit_for_bit(name, scope, coordinates, use, tmp_path):
    """Oracle: the filter that never stopped; stopped between odometry and frame, with motion pending."""
    count = 32 if scope == "reduced" else 12
    slam = LandmarkSlam(
        VelocitySteering(biases=STEERING_BIASES[:1]),
        RangeBearing(mount=(0.3, 0.0, 0.01)),
        LINEARISERS[name],
        scope=scope,
        coordinates=coordinates,
        use=use,
        start=(1.0, 2.0, 0.3),
        start_covariance=0.01 * np.eye(3),
    )
    resumed = assert_goes_on(slam, tmp_path / "filter", EVENTS[:count], count // 2 + 1)
    assert (resumed.scope, resumed.coordinates, resumed.use) == (scope, coordinates, use)
    assert (
        resumed.lineariser == slam.lineariser
        and resumed.motion == slam.motion
        and resumed.sensor == slam.sensor
    )


@pytest.mark.parametrize("stop", [0, 1, 2, 9, 31])
def test_any_moment_and_the_memory_of_an_associator(stop, tmp_path):
    """Oracle: as above, with landmarks on trial in the memory, and before the first event too."""
    slam = LandmarkSlam(association=Likelihood(management=Trial(confirm=4, window=9)))
    resumed = assert_goes_on(slam, tmp_path / "filter", EVENTS, stop)
    np.testing.assert_array_equal(resumed.frame_labels, slam.frame_labels)
    assert resumed.association == slam.association


def told_more(events: list) -> list:
    """The drive with clutter in every other frame and a diameter for each sighting."""
    rng, told = np.random.default_rng(6), []
    for number, event in enumerate(events):
        if isinstance(event, Sightings):
            false = np.c_[rng.uniform(3, 25, 2), rng.uniform(-1.2, 1.2, 2)][: 2 * (number % 4 == 1)]
            z, ids = np.vstack([event.values, false]), np.append(event.ids, np.full(len(false), 77 + number))
            measured = 0.1 + 0.05 * (ids % 9) + rng.normal(0, 0.02, len(ids))
            event = Sightings(event.time, z, ids, attributes={"diameter": measured})
        told.append(event)
    return told


DIAMETER = Attribute(name="diameter", sigma=0.1, ratio=0.1)
ASSOCIATORS = {
    "known": KnownIds(),
    "nearest": Nearest(management=Counter(), merging=Merging()),
    "hungarian": Nearest(one_to_one=True, management=Existence(), region=Region(local=False)),
    "likelihood": Likelihood(management=Trial(2, 5), attributes=(DIAMETER,), extent=0.2),
    "jcbb": Jcbb(management=Existence(), merging=Merging(), randomised_from=3),
    "djnn": Djnn(merging=Merging(frames=2, gate=0.999), attributes=(DIAMETER,), gate=0.6, new_gate=0.6),
}  # fmt: skip


@pytest.mark.parametrize("stop", [1, 14, 31, 55])
@pytest.mark.parametrize("name", ASSOCIATORS)
@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
def test_every_associator_goes_on_bit_for_bit(name, stop, coordinates, tmp_path):
    """Oracle: the filter that never stopped: state, memory, labels, mergers and what was rejected."""
    slam = LandmarkSlam(association=ASSOCIATORS[name], coordinates=coordinates)
    events = told_more(circle_events(4, frames=40))
    resumed = assert_goes_on(slam, tmp_path / "filter", events, stop)
    assert resumed.association == slam.association
    np.testing.assert_array_equal(resumed.frame_labels, slam.frame_labels)
    labels = np.arange(slam._founded)
    np.testing.assert_array_equal(resumed.settled_labels(labels), slam.settled_labels(labels))
    np.testing.assert_array_equal(resumed.estimate().landmarks.existence, slam.estimate().landmarks.existence)
    assert slam.landmark_count >= 8 and (slam.merged or name != "djnn")
    assert slam.rejected or name in ("known",)


def test_a_sensor_without_limit_can_be_saved(tmp_path):
    """Oracle: bit for bit; an infinite range is a number that a file must hold."""
    resumed = assert_goes_on(
        LandmarkSlam(sensor=RangeBearing(max_range=np.inf)), tmp_path / "filter", EVENTS, 8
    )
    assert resumed.sensor.max_range == np.inf


def test_saving_replaces_the_file_and_leaves_nothing_else(tmp_path):
    """Oracle: the folder's contents."""
    slam = feed(LandmarkSlam(), EVENTS[:4])
    slam.save(tmp_path / "filter")
    feed(slam, EVENTS[4:8])
    slam.save(tmp_path / "filter")
    assert [p.name for p in tmp_path.iterdir()] == ["filter"]
    assert state_of(LandmarkSlam.load(tmp_path / "filter")) == state_of(slam)


def test_parts_of_ones_own_are_refused(tmp_path):
    """Oracle: ConfigError, and no file."""
    with pytest.raises(ConfigError, match="not built in"):
        LandmarkSlam(sensor=XYSensor(np.eye(2))).save(tmp_path / "filter")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "filter"
    feed(LandmarkSlam(), EVENTS[:6]).save(path)
    return path.read_bytes()


def test_truncated_files_are_refused(saved, tmp_path):
    """Oracle: LogError naming the file, wherever it was cut."""
    lengths = cuts(saved, 97)
    assert refused_cuts(saved, tmp_path / "filter", LandmarkSlam.load, lengths) == lengths


def test_flipped_bytes_are_refused_or_harmless(saved, tmp_path):
    """Oracle: LogError, or exactly the state that was saved (a byte that means nothing)."""
    flips = flipped(saved, tmp_path / "filter", lambda path: state_of(LandmarkSlam.load(path)), 5)
    assert flips.believed == []
    assert len(flips.refused) + len(flips.harmless) == len(range(0, len(saved), 5))
    assert len(flips.refused) > len(flips.harmless)


def rewrite(saved: bytes, path, header=None, **arrays) -> None:
    """The saved filter with parts replaced, well packed otherwise."""
    (path).write_bytes(saved)
    with np.load(path) as stored:
        parts = {name: stored[name] for name in stored.files}
    text = parts["header"].tobytes()
    codec = msgspec.json if text.startswith(b"{") else msgspec.msgpack
    content = codec.decode(text) | (header or {})
    parts |= {"header": np.frombuffer(codec.encode(content), dtype=np.uint8), **arrays}
    with open(path, "wb") as file:
        np.savez(file, **parts)


@pytest.mark.parametrize(
    "change",
    [
        {"header": {"format": "kalmap-filter/99"}},
        {"header": {"surprise": 1}},
        {"header": {"scope": "sideways"}},
        {"header": {"ids": [1]}},
        {"header": {"counts": [1]}},
        {"header": {"robot": 4}},
        {"header": {"time": "yesterday"}},
        {"header": {"memory": 3}},
        {"header": {"memory": [[0, 77]]}},
        {"mean": np.zeros(4)},
        {"packed": np.zeros(3)},
        {"phi": np.eye(2)},
        {"phi": np.eye(5)},
        {"mean": np.full(3, "x")},
        {"mean": np.array([None, None], dtype=object)},
    ],
    ids=lambda change: (
        "-".join(map(str, next(iter(change.values())))) if "header" in change else next(iter(change))
    ),
)
def test_files_that_contradict_themselves_are_refused(saved, tmp_path, change):
    """Oracle: LogError naming the file; nothing of it is believed."""
    path = tmp_path / "filter"
    rewrite(saved, path, **change)
    with pytest.raises(LogError) as caught:
        LandmarkSlam.load(path)
    assert caught.value.file == path
    assert FORMAT == "kalmap-filter/2"


LISTS = {"confirmed": [True], "score": [1.0], "serial": [0], "known": [[]], "founded": 1}


@pytest.mark.parametrize(
    "memory",
    [3, [], {}, "x", None, LISTS, LISTS | {"score": []}, {"confirmed": 3}, [[0, 77]]],
    ids=lambda memory: str(memory)[:12],
)
def test_a_memory_that_does_not_fit_the_map_is_refused(memory, tmp_path):
    """Oracle: LogError naming the file: six landmarks, and a memory of one or of none."""
    path = tmp_path / "filter"
    feed(LandmarkSlam(association=Djnn()), EVENTS[:6]).save(path)
    rewrite(path.read_bytes(), path, header={"memory": memory})
    with pytest.raises(LogError) as caught:
        LandmarkSlam.load(path)
    assert caught.value.file == path


def test_foreign_files_are_refused(tmp_path):
    """Oracle: LogError for a text, an array of numpy, another archive,
    a folder and a file that is not there."""
    path = tmp_path / "filter"
    for write in (
        lambda: path.write_text("time,speed\n0,1\n"),
        lambda: np.save(path.open("wb"), np.eye(3)),
        lambda: np.savez(path.open("wb"), other=np.eye(3)),
        lambda: path.unlink(),
        lambda: path.mkdir(),
    ):
        write()
        with pytest.raises(LogError):
            LandmarkSlam.load(path)
    assert path.is_dir()
