"""A filter saved while frames wait for their decision goes on bit for bit; files that contradict themselves do not."""

from __future__ import annotations

import itertools
from functools import partial

import msgspec
import numpy as np
import pytest

import damage
from kalmap.association import Attribute, Counter, Existence, Keep, KnownIds, Mda, Merging, Nearest, Trial
from kalmap.models import VelocitySteering
from kalmap.records import Odometry, Scan
from kalmap.slam import LandmarkSlam, run
from slam_problems import STEERING_BIASES, feed, log_of, state_of
from test_checkpoint import rewrite
from window_problems import DIAMETER, OVERTURNED, labels_of, rough_drive, still

KIND = Attribute(name="kind", classes=True)
METHODS = {
    "two": Mda(management=Keep()),
    "three": Mda(window=3, management=Trial(3), attributes=(DIAMETER, KIND), merging=Merging()),
    "four": Mda(window=4, management=Counter(), extent=0.1, ambiguity=2.0),
    "five": Mda(window=5, management=Existence(), gate=0.7, new_gate=0.7, merging=Merging(frames=2)),
}  # fmt: skip


def told_all(events: list) -> list:
    """The drive with everything that an event can hold: covariances, attributes, sweeps, records and files."""
    rng, full = np.random.default_rng(8), []
    for number, event in enumerate(events):
        more = {"record": number, "file": f"part {number % 3}.csv"}
        if isinstance(event, Odometry):
            if number % 3 == 0:
                more["covariance"] = np.tile(np.diag([0.05, 0.002]), (len(event.durations), 1, 1))
        else:
            count = len(event.values)
            more["attributes"] = dict(event.attributes, kind=rng.integers(0, 3, count))
            bearings = np.linspace(-1.5, 1.5, 31)
            if number % 2:
                more["scan"] = Scan(
                    event.time, rng.uniform(5, 40, 31), bearings, rng.random(31), number, "s", event.time
                )
            if number % 5 < 2:
                more["covariance"] = np.tile(np.diag([0.01, 4e-4]), (count, 1, 1))
        full.append(msgspec.structs.replace(event, **more))
    return full


def waiting_of(slam: LandmarkSlam) -> list:
    """The frames that wait, as comparable values."""

    def plain(value):
        if isinstance(value, np.ndarray):
            return value.dtype.str, value.shape, value.tobytes()
        if isinstance(value, np.generic):
            return value.item()
        n = value.n
        numbers = value.mean[:n], value.packed[: n * (n + 1) // 2], value.phi
        return [each.tobytes() for each in numbers], value.pending

    return [msgspec.to_builtins(entry, enc_hook=plain) for entry in slam._window.pending]


@pytest.mark.parametrize("stop", [0, 1, 3, 22, 37, 60])
@pytest.mark.parametrize("coordinates", ["additive", "invariant"])
@pytest.mark.parametrize("name", METHODS)
def test_it_goes_on_bit_for_bit(name, coordinates, stop, tmp_path):
    """Oracle: the filter that never stopped: what waits, state, labels and revisions after every later event; saved
    before the first frame, between frames and odometry, and with frames at one time."""
    slam = LandmarkSlam(association=METHODS[name], coordinates=coordinates)
    events, revised = told_all(rough_drive(4)), 0
    feed(slam, events[:stop]).save(tmp_path / "filter")
    resumed = LandmarkSlam.load(tmp_path / "filter")
    assert waiting_of(resumed) == waiting_of(slam)
    assert state_of(resumed) == state_of(slam) and resumed.association == slam.association
    for event in events[stop:]:
        slam.step(event)
        resumed.step(event)
        if isinstance(event, Odometry):
            continue
        assert resumed.frame_labels.tolist() == slam.frame_labels.tolist()
        one, two = ({f: r[0].tolist() for f, r in each.frame_revisions.items()} for each in (slam, resumed))
        assert one == two
        revised += len(one)
    assert state_of(resumed) == state_of(slam) and waiting_of(resumed) == waiting_of(slam)
    assert revised >= 5 and len(waiting_of(slam)) == METHODS[name].window - 1
    labels = np.arange(slam._founded)
    np.testing.assert_array_equal(resumed.settled_labels(labels), slam.settled_labels(labels))


@pytest.mark.parametrize("scope", ["reduced", "full"])
def test_it_goes_on_with_biases_in_both_scopes(scope, tmp_path):
    """Oracle: as above; saved again after it was loaded."""
    slam = LandmarkSlam(
        VelocitySteering(biases=STEERING_BIASES[:2]),
        association=Mda(window=3),
        scope=scope,
        start_covariance=0.01 * np.eye(3),
    )
    events, path = rough_drive(5, frames=40 if scope == "reduced" else 9), tmp_path / "filter"
    resumed = slam
    for begin, end in itertools.pairwise([0, 8, 13, len(events)]):
        feed(slam, events[begin:end])
        if resumed is not slam:
            feed(resumed, events[begin:end])
        assert state_of(resumed) == state_of(slam) and waiting_of(resumed) == waiting_of(slam)
        resumed.save(path)
        resumed = LandmarkSlam.load(path)


def test_saving_changes_nothing(tmp_path):
    """Oracle: a filter that was never saved; the file holds what was then, whatever happens to the filter after."""
    slam, twin, events = LandmarkSlam(association=METHODS["three"]), None, told_all(rough_drive(6))
    feed(slam, events[:20]).save(tmp_path / "filter")
    first = (tmp_path / "filter").read_bytes()
    feed(slam, events[20:])
    twin = feed(LandmarkSlam(association=METHODS["three"]), events)
    assert state_of(slam) == state_of(twin) and waiting_of(slam) == waiting_of(twin)
    feed(LandmarkSlam(association=METHODS["three"]), events[:20]).save(tmp_path / "again")
    with np.load(tmp_path / "filter") as one, np.load(tmp_path / "again") as two:
        assert sorted(one.files) == sorted(two.files) and len(one.files) > 30
        assert all(one[name].tobytes() == two[name].tobytes() for name in one.files)
    assert (tmp_path / "filter").read_bytes() == first


def test_a_run_that_is_resumed_revises_only_what_it_has_seen(tmp_path):
    """Oracle: by hand: the story of the overturned frame, cut before its last frame: the frame that is revised belongs
    to the first run, and the second run's own labels are those of the whole story."""
    settings = still(management=Trial(confirm=3))
    slam = LandmarkSlam(**settings)
    first = run(slam, log_of(OVERTURNED[:6]), explain=True)
    assert first.labels.tolist() == [0, 0, 0, -2]
    slam.save(tmp_path / "filter")
    resumed = LandmarkSlam.load(tmp_path / "filter")
    second = run(resumed, log_of(OVERTURNED[6:]), explain=True)
    assert second.error is None and second.labels.tolist() == labels_of(OVERTURNED, **settings)[3]
    assert list(resumed.frame_revisions) == [2] and [entry.number for entry in second.decisions] == [3]
    assert state_of(resumed) == state_of(feed(LandmarkSlam(**settings), OVERTURNED))


# --- files that are none --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "filter"
    slam = feed(LandmarkSlam(association=METHODS["four"]), told_all(rough_drive(4))[:24])
    assert len(slam._window.pending) == 3 and all(len(entry.applied) for entry in slam._window.pending)
    slam.save(path)
    return path.read_bytes()


refused = partial(damage.refused, LandmarkSlam.load)


def test_truncated_files_are_refused(saved, tmp_path):
    """Oracle: LogError naming the file, wherever it was cut."""
    lengths = list(range(0, len(saved), 331))
    assert damage.refused_cuts(saved, tmp_path / "filter", LandmarkSlam.load, lengths) == lengths


def test_flipped_bytes_are_refused_or_harmless(saved, tmp_path):
    """Oracle: LogError, or exactly what was saved (a byte that means nothing)."""

    def state(path) -> tuple:
        slam = LandmarkSlam.load(path)
        return state_of(slam), waiting_of(slam)

    flips = damage.flipped(saved, tmp_path / "filter", state, 211)
    assert flips.believed == []
    assert len(flips.refused) + len(flips.harmless) == len(range(0, len(saved), 211))
    assert len(flips.refused) > len(flips.harmless)


def test_every_array_must_fit(saved, tmp_path):
    """Oracle: LogError when any one of the arrays is too long, of another kind, or missing."""
    path = tmp_path / "filter"
    path.write_bytes(saved)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name.startswith("array")}
    assert len(arrays) > 40
    for name, values in arrays.items():
        for bad in (np.concatenate([values, values[-1:]]), values.astype(complex)):
            rewrite(saved, path, **{name: bad})
            same = bad.shape == values.shape and bad.dtype == values.dtype  # nothing to make longer
            assert same or refused(path), (name, bad.shape, bad.dtype)
    content = {name: values for name, values in arrays.items() if name != "array7"}
    with np.load(path) as stored:
        content |= {name: stored[name] for name in ("header", "mean", "packed", "phi")}
    with open(path, "wb") as file:
        np.savez(file, **content)
    assert refused(path)


def header_of(saved: bytes, path) -> dict:
    path.write_bytes(saved)
    with np.load(path) as stored:
        return msgspec.msgpack.decode(stored["header"].tobytes())


CHANGES = {
    "too many": lambda w: w.append(w[0]),
    "another order": lambda w: w.reverse(),
    "a number for a frame": lambda w: w.__setitem__(0, 3),
    "a surprise": lambda w: w[0].update(surprise=1),
    "no array of this number": lambda w: w[0].update(noises=99999),
    "no array at all": lambda w: w[0].update(noises="much"),
    "no belief": lambda w: w[0].update(tracks=[1, 2]),
    "a map of another frame": lambda w: w[0].update(tracks=w[1]["tracks"]),
    "a belief of others": lambda w: w[2]["before"].update(belief=w[0]["tracks"]),
    "labels for others": lambda w: w[0].update(applied=[1]),
    "labels that are none": lambda w: w[0].update(applied="none"),
    "counts for others": lambda w: w[0]["before"].update(counts=[1]),
    "landmarks that are not there": lambda w: w[0]["before"].update(ids=[1]),
    "a memory of others": lambda w: w[0]["before"].update(memory=msgspec.msgpack.encode(KnownIds().start())),
    "a memory that is none": lambda w: w[0]["before"].update(memory=b"\xc1"),
    "no links": lambda w: w[2]["glance"].update(links=[]),
    "links to others": lambda w: w[2]["glance"].update(links=w[2]["glance"]["links"][::-1]),
    "another's odometry": lambda w: w[0]["later"].append({"time": 0.0, "values": 0, "durations": 0}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_waits_must_fit(change, saved, tmp_path):
    """Oracle: LogError naming the file; the file without the change is good."""
    path = tmp_path / "filter"
    waiting = header_of(saved, path)["window"]
    assert not refused(path)
    CHANGES[change](waiting)
    rewrite(saved, path, header={"window": waiting})
    assert refused(path)


def test_nothing_waits_where_nothing_is_decided_later(saved, tmp_path):
    """Oracle: LogError: a filter without a window that has frames waiting; without them it is good."""
    path = tmp_path / "filter"
    waiting = header_of(saved, path)["window"]
    LandmarkSlam(association=Nearest(management=Counter())).save(path)
    plain = path.read_bytes()
    assert not refused(path)
    rewrite(saved, path, header=msgspec.msgpack.decode(_header(plain, path)) | {"window": waiting[:1]},
            mean=np.zeros(3), packed=np.zeros(6), phi=np.eye(3))  # fmt: skip
    assert refused(path)


def _header(content: bytes, path) -> bytes:
    path.write_bytes(content)
    with np.load(path) as stored:
        return stored["header"].tobytes()


def test_old_arrays_are_not_believed(saved, tmp_path):
    """Oracle: LogError for a sighting array with objects in it: nothing is ever unpickled."""
    path = tmp_path / "filter"
    rewrite(saved, path, array0=np.array([None, {}], dtype=object))
    assert refused(path)
