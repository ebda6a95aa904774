"""A saved finite-set filter goes on bit for bit, generator and all; a damaged or foreign file is refused."""

from __future__ import annotations

import copy

import msgspec
import numpy as np
import pytest

from damage import cuts, flipped, refused_cuts
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import ConfigError, FiniteSetConfig, LogError
from kalmap.slam import LandmarkSlam
from kalmap.slam.finite_set import FiniteSetSlam
from kalmap.slam.set_checkpoint import FORMAT
from slam_problems import STEERING_BIASES, circle_events, feed
from test_checkpoint import rewrite
from window_problems import rough_drive

METHODS = {
    "rb-phd": {"method": "rb-phd"},
    "published": {"method": "srckf-phd", "proposal": "motion", "weighting": "single-feature"},
    "srckf-phd": {"method": "srckf-phd", "estimate": False},
    "mh-fastslam": {"method": "mh-fastslam", "branches": 3},
    "pmb": {"method": "pmb", "detection_far": 0.5, "threads": 2, "particles": 9},
}
EVENTS = rough_drive(4)


def make(name: str = "pmb", biases: int = 0, **more) -> FiniteSetSlam:
    return FiniteSetSlam(
        VelocitySteering(biases=STEERING_BIASES[:biases]),
        RangeBearing(max_range=30.0, mount=(0.3, 0.0, 0.01)),
        FiniteSetConfig(**{"particles": 5, "threads": 1, **METHODS[name], **more}),
        start=(1.0, 2.0, 0.3),
        start_covariance=0.01 * np.eye(3),
        seed=5,
        extent=0.1,
    )


def set_state_of(slam: FiniteSetSlam) -> tuple:
    """Everything that the filter knows, as comparable values."""
    particles, ahead, rates = slam._particles, slam._ahead, slam.rates
    arrays = (
        *(particles.poses, particles.biases, particles.log_weights, slam._left, slam._pose, slam._spread),
        *(rates.stated, rates.could, rates.were, ahead.reference, ahead.covariance),
        *(ahead.belief.mean, ahead.belief.packed, ahead.belief.phi),
        *(slam.map(particle) for particle in range(len(particles))),
    )
    return (
        [array.tobytes() for array in arrays],
        copy.deepcopy(slam.rng.bit_generator.state),
        (rates.clutter, rates.frames, rates.false_, dict(slam._numbers), slam.landmark_count),
        (slam.time, slam._moved, slam.frames_taken, slam.step_number, slam.resampled, slam.recovered),
    )


def said(slam: FiniteSetSlam) -> list[bytes]:
    estimate = slam.estimate()
    marks = estimate.landmarks
    parts = (
        estimate.pose,
        estimate.covariance,
        marks.ids,
        marks.positions,
        marks.covariances,
        marks.existence,
    )
    return [part.tobytes() for part in (*parts, *estimate.joint())]


@pytest.mark.parametrize("stop", [0, 1, 2, 17, 40, len(EVENTS)])
@pytest.mark.parametrize("name", METHODS)
def test_a_resumed_run_is_the_same_bit_for_bit(name, stop, tmp_path):
    """Oracle: the filter that never stopped: before the first event, between odometry and frame, among empty frames
    and at the end: particles, maps, rates, generator, estimate and numbers of landmarks."""
    slam = make(name, biases=stop % 3)
    feed(slam, EVENTS[:stop]).save(tmp_path / "filter")
    resumed = FiniteSetSlam.load(tmp_path / "filter")
    assert set_state_of(resumed) == set_state_of(slam)
    assert (resumed.config, resumed.motion, resumed.sensor) == (slam.config, slam.motion, slam.sensor)
    for event in EVENTS[stop:]:
        slam.step(event)
        resumed.step(event)
        assert resumed.pose.tobytes() == slam.pose.tobytes()
        assert resumed.pose_covariance.tobytes() == slam.pose_covariance.tobytes()
    assert said(resumed) == said(slam) and set_state_of(resumed) == set_state_of(slam)
    assert slam.landmark_count > 3 and len(EVENTS) > 60


def test_saving_again_and_again_changes_nothing(tmp_path):
    """Oracle: the filter that never stopped, against one that was saved and loaded before every event; the folder."""
    slam, resumed = make("mh-fastslam"), make("mh-fastslam")
    for event in EVENTS[:40]:
        resumed.save(tmp_path / "filter")
        resumed = FiniteSetSlam.load(tmp_path / "filter")
        slam.step(event)
        resumed.step(event)
    assert set_state_of(resumed) == set_state_of(slam)
    assert [path.name for path in tmp_path.iterdir()] == ["filter"]


def test_the_file_holds_no_room_to_grow(tmp_path):
    """Oracle: counted: 5 particles with maps of a few rows of 8 numbers, not the 64 rows that they have room for."""
    slam = feed(make(), circle_events(4, frames=6))
    slam.save(tmp_path / "filter")
    with np.load(tmp_path / "filter") as stored:
        most = max(array.size for array in (stored[name] for name in stored.files if name != "header"))
    assert most == len(slam._particles.counts) * slam._particles.counts.max() * 8 < 9 * 64 * 8


def test_another_generator_is_refused(tmp_path):
    """Oracle: ConfigError, and no file."""
    slam = make()
    slam.rng = np.random.Generator(np.random.MT19937(1))
    with pytest.raises(ConfigError, match="MT19937"):
        slam.save(tmp_path / "filter")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "filter"
    feed(make(), EVENTS[:12]).save(path)
    return path.read_bytes()


def test_truncated_files_are_refused(saved, tmp_path):
    """Oracle: LogError naming the file, wherever it was cut."""
    lengths = cuts(saved, 397)
    assert refused_cuts(saved, tmp_path / "filter", FiniteSetSlam.load, lengths) == lengths


def test_flipped_bytes_are_refused_or_harmless(saved, tmp_path):
    """Oracle: LogError, or exactly the state that was saved (a byte that means nothing)."""
    flips = flipped(saved, tmp_path / "filter", lambda path: set_state_of(FiniteSetSlam.load(path)), 23)
    assert flips.believed == []
    assert len(flips.refused) + len(flips.harmless) == len(range(0, len(saved), 23))
    assert len(flips.refused) > len(flips.harmless)


def parts_of(saved: bytes, path) -> tuple[dict, dict]:
    """(header, arrays) of a file."""
    path.write_bytes(saved)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return msgspec.msgpack.decode(arrays.pop("header").tobytes()), arrays


CLOUD = ("poses", "biases", "log_weights", "slots", "blocks", "counts", "left")


@pytest.mark.parametrize(
    "change",
    [lambda a: a[:-1], lambda a: a.astype("U4"), lambda a: a[None]],
    ids=["a row too few", "texts", "another shape"],
)
@pytest.mark.parametrize("part", CLOUD)
def test_arrays_that_do_not_fit_are_refused(saved, tmp_path, part, change):
    """Oracle: LogError naming the file: one row too few, texts, another shape."""
    path = tmp_path / "filter"
    header, arrays = parts_of(saved, path)
    name = f"array{header['cloud'][part]}"
    rewrite(saved, path, **{name: change(arrays[name])})
    with pytest.raises(LogError) as caught:
        FiniteSetSlam.load(path)
    assert caught.value.file == path


def test_maps_that_are_not_there_are_refused(saved, tmp_path):
    """Oracle: LogError: numbers of rows and of maps beyond what the file holds, and particles without weight."""
    path = tmp_path / "filter"
    header, arrays = parts_of(saved, path)
    for part, value in (
        *(("counts", 10_000), ("counts", -1), ("slots", 99), ("slots", -1)),
        *(("log_weights", np.nan), ("log_weights", -np.inf)),
    ):
        name = f"array{header['cloud'][part]}"
        rewrite(saved, path, **{name: np.full_like(arrays[name], value)})
        with pytest.raises(LogError):
            FiniteSetSlam.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"format": "kalmap-set-filter/99"},
        {"format": "kalmap-filter/2"},
        {"surprise": 1},
        {"time": "yesterday"},
        {"numbers": 3},
        {"config": {"method": "pmb", "particles": 6}},
        {"config": {"method": "phd"}},
        {"config": {"method": None}},
        {"config": {"method": "pmbm", "particles": 9}},
        {"random": {"state": "g", "inc": "1", "has_uint32": 0, "uinteger": 0}},
        {"random": {"state": "f" * 33, "inc": "1", "has_uint32": 0, "uinteger": 0}},
        {"random": {"state": "1", "inc": "1", "has_uint32": 0, "uinteger": -1}},
        {"random": {"state": "1", "inc": "1", "has_uint32": 2, "uinteger": 0}},
        {"cloud": {}},
        {"count": "many"},
    ],
    ids=str,
)
def test_headers_that_contradict_themselves_are_refused(saved, tmp_path, change):
    """Oracle: LogError naming the file."""
    path = tmp_path / "filter"
    rewrite(saved, path, header=change)
    with pytest.raises(LogError) as caught:
        FiniteSetSlam.load(path)
    assert caught.value.file == path
    assert FORMAT == "kalmap-set-filter/1"


def test_foreign_files_are_refused(tmp_path):
    """Oracle: LogError for a text, a Kalman filter's file, a folder and a file that is not there; the Kalman filter
    refuses a set's likewise."""
    path = tmp_path / "filter"
    for write in (
        lambda: path.write_text("time,speed\n0,1\n"),
        lambda: LandmarkSlam().save(path),
        lambda: path.unlink(),
        lambda: path.mkdir(),
    ):
        write()
        with pytest.raises(LogError):
            FiniteSetSlam.load(path)
    make().save(tmp_path / "set")
    with pytest.raises(LogError):
        LandmarkSlam.load(tmp_path / "set")
