"""A map of contours, saved and resumed: bit for bit the run that never stopped; damaged and foreign files refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contour_rooms import block_log, events_of, mapper
from damage import cuts, flipped, refused_cuts
from kalmap.gaussian import CentralDifference
from kalmap.records import ConfigError, ContourConfig, LogError, Odometry, Scan
from kalmap.slam import LandmarkSlam
from kalmap.slam.contours.checkpoint import FORMAT
from kalmap.slam.contours.graph import FrameGraph
from kalmap.slam.contours.live import LiveMap
from kalmap.slam.contours.loops import Loops
from kalmap.slam.contours.matching import Overlay
from kalmap.slam.contours.scan_store import scans_of, stored_scans
from kalmap.slam.contours.slam import ContourSlam
from kalmap.slam.contours.wider import Glimpse, Wider
from test_checkpoint import rewrite
from test_set_checkpoint import parts_of


@pytest.fixture(scope="module")
def log():
    return block_log()


@pytest.fixture(scope="module")
def events(log):
    return events_of(log, 260)


def said(slam: ContourSlam) -> tuple:
    """All that the estimate says, as bytes."""
    estimate = slam.estimate()
    sweeps = estimate.sweeps()
    parts = [estimate.pose, estimate.covariance, sweeps.poses]
    parts += [getattr(estimate.contours, name) for name in estimate.contours.__struct_fields__]
    parts += [getattr(estimate.trajectory, name) for name in estimate.trajectory.__struct_fields__]
    parts += [part for scan in sweeps.scans for part in (scan.ranges, scan.bearings, scan.intensities)]
    scans = [(scan.time, scan.record, scan.file, repr(scan.stamp)) for scan in sweeps.scans]
    return (
        estimate.time,
        estimate.counts,
        scans,
        [b"" if part is None else np.asarray(part).tobytes() for part in parts],
    )


def shown(slam: ContourSlam) -> tuple:
    """What the run loop asks of it after every event."""
    return (
        slam.time,
        slam.pose.tobytes(),
        slam.pose_covariance.tobytes(),
        slam.landmark_count,
        slam.frames_taken,
    )


@pytest.fixture(scope="module")
def ends(log, events) -> list[int]:
    """After which events a local map has just been closed."""
    slam, found = mapper(log), []
    for number, event in enumerate(events):
        before = len(slam._ends)
        slam.step(event)
        if len(slam._ends) > before:
            found.append(number + 1)
    return found


def fed(slam: ContourSlam, events) -> ContourSlam:
    for event in events:
        slam.step(event)
    return slam


@pytest.mark.parametrize(
    "stop", ["first", "odometry", "scan", "leg", "closing", "second closing", "late", "end"]
)
def test_a_resumed_run_is_the_same_bit_for_bit(log, events, ends, stop, tmp_path):
    """Oracle: the run that never stopped, at every event and in the end; the drive closes maps and finds loops."""
    at = {
        "first": 0,
        "odometry": 1,
        "scan": 2,
        "leg": ends[0] + 30,
        "closing": ends[0],
        "second closing": ends[1],
    }
    at |= {"late": len(events) - 3, "end": len(events)}
    slam = fed(mapper(log), events[: at[stop]])
    slam.save(tmp_path / "run")
    resumed = ContourSlam.load(tmp_path / "run")
    assert shown(resumed) == shown(slam) and said(resumed) == said(slam)
    for event in events[at[stop] :]:
        slam.step(event)
        resumed.step(event)
        assert shown(resumed) == shown(slam)
        assert repr(resumed.frame_nis) == repr(slam.frame_nis) or not isinstance(event, Scan)
    assert said(resumed) == said(slam)
    assert slam.estimate().counts["loops"] >= 3 and len(ends) >= 4


@pytest.mark.parametrize("method", ["slasem", "dc-slasem"])
@pytest.mark.parametrize("stop", [0, 155, 333])
def test_in_one_map_and_in_the_background_too(log, events, method, stop, tmp_path):
    """Oracle: the run that never stopped, with sigma points and additive coordinates; only in the background does the
    pose on the way depend on how far the joins are."""
    settings = {"method": method, "background": method == "dc-slasem"}
    slam = mapper(log, **settings)
    slam = ContourSlam(
        slam.motion, slam.scanner, slam.settings, CentralDifference(), "additive", start=log.start
    )
    fed(slam, events[:stop]).save(tmp_path / "run")
    resumed = ContourSlam.load(tmp_path / "run")
    assert (resumed.settings, resumed.motion, resumed.scanner) == (slam.settings, slam.motion, slam.scanner)
    assert (resumed.lineariser, resumed.coordinates) == (slam.lineariser, "additive")
    for event in events[stop:]:
        slam.step(event)
        resumed.step(event)
        assert method == "dc-slasem" or shown(resumed) == shown(slam)
    assert said(resumed) == said(slam)


def test_saving_again_and_again_changes_nothing(log, events, tmp_path):
    """Oracle: the run that never stopped, against one that was saved and loaded every few events; the folder."""
    slam, resumed = mapper(log, close_distance=2.0), mapper(log, close_distance=2.0)
    for number, event in enumerate(events[:180]):
        if number % 7 == 0:
            resumed.save(tmp_path / "run")
            resumed = ContourSlam.load(tmp_path / "run")
        slam.step(event)
        resumed.step(event)
    assert said(resumed) == said(slam)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_run_that_estimates_a_latency_resumes_as_well(log, events, ends, tmp_path):
    """Oracle: the run that never stopped; what is saved is the odometry of the last two seconds."""
    at, settings = ends[0] + 31, {"sigma_latency": 0.1, "sigma_stamp": 0.02}
    slam = fed(mapper(log, **settings), events[:at])
    slam.save(tmp_path / "run")
    resumed = fed(ContourSlam.load(tmp_path / "run"), events[at : at + 60])
    assert shown(resumed) == shown(fed(slam, events[at : at + 60])) and said(resumed) == said(slam)


def test_everything_that_is_known_is_saved():
    """Whoever gives these classes a field must save it: the fields as they were when the format was made."""
    log = block_log()
    # the witness is of the legs, and given anew whenever something is asked
    assert set(vars(Loops())) == {"maps", "graph", "open", "searched", "wider", "witness", "_misfits"}
    assert set(vars(Wider())) == {"glimpses", "_signatures"}  # these are made of the maps anew
    assert set(vars(FrameGraph())) == {
        "frames",
        "relations",
        "scale",
        "_spread",
    }  # the scale is the loops' own
    live = vars(LiveMap(mapper(log).rules)).items()
    held = {name for name, value in live if not isinstance(value, (int, float))}
    assert held == {"rules", "belief", "_setup", "_since", "_last_pose", "normals", "sightings", "open"}
    assert set(vars(mapper(log))) == {
        *("motion", "scanner", "settings", "lineariser", "coordinates", "rules", "sensor", "_start"),
        *(
            "_start_covariance",
            "_live",
            "_leg",
            "_ends",
            "_worker",
            "_time",
            "_moved",
            "_way",
            "_turn",
            "_twist",
            "_clock",
            "_changes",
        ),
        *(
            "_frames",
            "_estimate",
            "_framed",  # what was told last: told again, not saved
            "_told",
            "frame_nis",
            "frame_used",
            "frame_labels",
            "frame_sightings",
            "frame_revisions",
        ),
    }


def test_places_of_lost_maps_are_kept(log, events, tmp_path):
    """What was found for maps whose place is not known yet comes back as it was, and one between no maps is refused."""
    slam = mapper(log)
    for event in events:
        slam.step(event)
    looks = slam._worker.settled().loops.wider
    found = Overlay(np.array([1.0, 2.0, 0.5]), 1e-3 * np.eye(3), 1e-4 * np.eye(3), 21.0, 0.95, 60.0, 77)
    looks.glimpses.append(Glimpse(0, 1, found))
    slam.save(tmp_path / "lost.kalmap")
    (again,) = ContourSlam.load(tmp_path / "lost.kalmap")._worker.settled().loops.wider.glimpses
    assert (again.first, again.second, again.matched, again.found.freedom) == (0, 1, 21.0, 77)
    for name in ("pose", "covariance", "with_end"):
        assert np.array_equal(getattr(again.found, name), getattr(found, name))
    looks.glimpses.append(Glimpse(0, 99, found))
    slam.save(tmp_path / "nowhere.kalmap")
    with pytest.raises(LogError, match="maps that are not there"):
        ContourSlam.load(tmp_path / "nowhere.kalmap")


def test_scans_are_kept_small(log, events, tmp_path):
    """Counted: bearings once, and ranges of a driver that speaks single precision in 4 bytes a beam."""
    rounded = [
        msgspec.structs.replace(event, ranges=event.ranges.astype(np.float32).astype(float))
        if isinstance(event, Scan)
        else event
        for event in events
    ]
    stored = stored_scans([event for event in rounded if isinstance(event, Scan)])
    assert len(stored.bearings) == 1 and stored.ranges.dtype == np.float32
    assert stored_scans([event for event in events if isinstance(event, Scan)]).ranges.dtype == float
    slam = fed(mapper(log, close_distance=1e3, close_samples=5000), rounded[:100])
    slam.save(tmp_path / "run")
    n = slam._live.belief.n
    assert (tmp_path / "run").stat().st_size < 50 * (120 * 4 + 8 * 15) + 8 * n * (n + 1) // 2 + 20_000


def test_scans_of_every_kind_come_back():
    """Oracle: the scans that were stored: NaN with a payload, infinities, no beams, intensities, stamps, file names."""
    payload = np.array([0x7FF8_0000_0000_0001], dtype=np.uint64).view(float)
    scans = [
        Scan(
            1.0, np.array([1.0, np.inf, -0.0]), np.array([0.0, 0.1, 0.2]), record=7, file="a.log", stamp=0.5
        ),
        Scan(2.0, np.zeros(0), np.zeros(0)),
        Scan(3.0, np.array([0.1, payload[0], 1e300]), np.array([0.0, 0.1, 0.2]), np.array([1.0, 2.0, 0.3])),
        Scan(4.0, np.array([5.0]), np.array([-0.0]), np.array([3.0]), file="b.log"),
        Scan(5.0, np.array([5.0]), np.array([0.0])),
    ]
    stored = stored_scans(scans)
    assert len(stored.bearings) == 4
    for before, after in zip(scans, scans_of(stored), strict=True):
        assert (before.time, before.record, before.file, repr(before.stamp)) == (
            *(after.time, after.record, after.file, repr(after.stamp)),
        )
        for name in ("ranges", "bearings", "intensities"):
            one, other = getattr(before, name), getattr(after, name)
            assert one is other is None or one.tobytes() == other.tobytes()
    assert scans_of(stored_scans([])) == []


@pytest.fixture(scope="module")
def saved(events, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "run"
    log = block_log(beams=40)
    slam = fed(mapper(log, close_distance=2.0, spacing=0.6, sigma_latency=0.1), events_of(log, 70))
    assert len(slam._ends) >= 2
    slam.save(path)
    return path.read_bytes()


def test_truncated_files_are_refused(saved, tmp_path):
    """Oracle: LogError naming the file, wherever it was cut."""
    lengths = cuts(saved, len(saved) // 60)
    assert refused_cuts(saved, tmp_path / "run", ContourSlam.load, lengths) == lengths


def test_flipped_bytes_are_refused_or_harmless(saved, tmp_path):
    """Oracle: LogError, or exactly what was saved (a byte that means nothing)."""
    flips = flipped(saved, tmp_path / "run", lambda path: said(ContourSlam.load(path)), len(saved) // 150)
    assert flips.believed == []
    assert len(flips.refused) > len(flips.harmless)


def numbers_of(header: dict) -> list[int]:
    """Of every array that the header speaks of."""
    live, loops = header["live"], header["loops"]
    found = [live[name] for name in ("normals", "sightings", "open")]
    found += [live["belief"][name] for name in ("mean", "packed", "phi")]
    found += [loops["frames"], header["start"], header["start_covariance"]]
    for each in loops["maps"]:
        found += [each[name] for name in ("mean", "packed", "normals", "sightings")]
    found += [loops["relations"][0][name] for name in ("pose", "information")]
    found += [header["late"][name] for name in ("begins", "ends", "poses", "ways", "covariances")]
    found += [header["twist"], *(each[name] for each in header["legs"] for name in ("driven", "twists"))]
    for each in (*header["legs"], header["ends"]):
        found += [each["poses"], each["covariances"]]
    scans = header["scans"]
    return found + [scans[name] for name in ("times", "stamps", "records", "file", "fan", "ranges", "bright")]


@pytest.mark.parametrize(
    "change",
    [lambda a: a[:-1], lambda a: a.astype("U4"), lambda a: a[None]],
    ids=["a row too few", "texts", "another shape"],
)
def test_arrays_that_do_not_fit_are_refused(saved, tmp_path, change):
    """Oracle: LogError naming the file: one row too few, texts, another shape."""
    path = tmp_path / "run"
    header, arrays = parts_of(saved, path)
    for number in numbers_of(header):
        rewrite(saved, path, **{f"array{number}": change(arrays[f"array{number}"])})
        with pytest.raises(LogError) as caught:
            ContourSlam.load(path)
        assert caught.value.file == path


@pytest.mark.parametrize(
    "change",
    [
        {"format": "kalmap-contours/99"},
        {"format": "kalmap-filter/2"},
        {"surprise": 1},
        {"time": "yesterday"},
        {"coordinates": "polar"},
        {"settings": {"method": "dc-slasem", "close_samples": 1}},
        {"legs": []},
        {"loops": {}},
        {"frames": "many"},
    ],
    ids=str,
)
def test_headers_that_contradict_themselves_are_refused(saved, tmp_path, change):
    """Oracle: LogError naming the file."""
    path = tmp_path / "run"
    rewrite(saved, path, header=change)
    with pytest.raises(LogError) as caught:
        ContourSlam.load(path)
    assert caught.value.file == path
    assert FORMAT == "kalmap-contours/4"


def test_relations_between_maps_that_are_not_there_are_refused(saved, tmp_path):
    """Oracle: LogError: beyond the maps, backwards, and of scans whose bearings the file does not hold."""
    path = tmp_path / "run"
    header, arrays = parts_of(saved, path)
    for first, second in ((0, 99), (1, 0), (-1, 1)):
        loops = header["loops"] | {"open": [(first, second, "far")]}
        rewrite(saved, path, header={"loops": loops})
        with pytest.raises(LogError):
            ContourSlam.load(path)
    for value in (-1, 99):
        name = f"array{header['scans']['fan']}"
        rewrite(saved, path, **{name: np.full_like(arrays[name], value)})
        with pytest.raises(LogError):
            ContourSlam.load(path)


def test_foreign_files_are_refused(tmp_path):
    """Oracle: LogError for a text, a Kalman filter's file, a folder and a file that is not there."""
    path = tmp_path / "run"
    for write in (
        lambda: path.write_text("time,speed\n0,1\n"),
        lambda: LandmarkSlam().save(path),
        lambda: path.unlink(),
        lambda: path.mkdir(),
    ):
        write()
        with pytest.raises(LogError):
            ContourSlam.load(path)


def test_a_part_that_is_not_built_in_cannot_be_saved(tmp_path):
    """Oracle: ConfigError, and no file."""

    class Own(CentralDifference, frozen=True):
        pass

    with pytest.raises(ConfigError, match="not built in"):
        ContourSlam(lineariser=Own(), settings=ContourConfig(method="slasem")).save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_run_with_nothing_in_it(tmp_path):
    """Before any event, and after odometry alone."""
    slam = ContourSlam()
    for number in range(2):
        slam.save(tmp_path / "run")
        assert said(ContourSlam.load(tmp_path / "run")) == said(slam)
        slam.step(Odometry(float(number), np.array([[0.1, 0.0, 0.0]]), np.array([1.0])))
