"""The readers on the real logs, against the counts and figures of the data sets' own description."""

from __future__ import annotations

import time

import numpy as np
import pytest

from kalmap.data import check_log, mrclam_robots, open_log, read_map, write_csv_log
from kalmap.perception import ReflectorDetector
from kalmap.records import Fix, Odometry, Scan, Sightings
from real_data import data_root  # noqa: F401


def of_kind(log, kind):
    return [event for event in log if isinstance(event, kind)]


def sightings_in(log):
    return sum(len(frame.values) for frame in of_kind(log, Sightings))


def dead_reckoning(log):
    """End times (n,) and poses (n, 3) of all samples from the log's start; midpoint rule."""
    blocks = of_kind(log, Odometry)
    values = np.concatenate([block.values for block in blocks])
    dt = np.concatenate([block.durations for block in blocks])
    motion = log.defaults.motion
    if motion.model == "ackermann":
        speed = values[:, 0] / (1 - motion.encoder_offset / motion.wheelbase * np.tan(values[:, 1]))
        turn, move = (
            speed / motion.wheelbase * np.tan(values[:, 1]) * dt,
            np.column_stack([speed * dt, 0 * dt]),
        )
    elif motion.model == "unicycle":
        turn, move = values[:, 1] * dt, np.column_stack([values[:, 0] * dt, 0 * dt])
    else:
        turn, move = values[:, 2], values[:, :2]
    heading = log.start[2] + np.cumsum(turn)
    direction = heading - (turn if motion.model == "increments" else turn / 2)
    cos, sin = np.cos(direction), np.sin(direction)
    x = log.start[0] + np.cumsum(cos * move[:, 0] - sin * move[:, 1])
    y = log.start[1] + np.cumsum(sin * move[:, 0] + cos * move[:, 1])
    ends = [block.time - block.durations.sum() + np.cumsum(block.durations) for block in blocks]
    return np.concatenate(ends), np.column_stack([x, y, heading])


def errors(times, positions, reference):
    """Distances of the reference's positions from the path, (K,) m, inside the path's span."""
    inside = (reference.times >= times[0]) & (reference.times <= times[-1])
    at = [np.interp(reference.times[inside], times, positions[:, k]) for k in (0, 1)]
    return np.hypot(*(np.array(at) - reference.positions[inside].T))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def in_order(events):
    stamps = [event.time for event in events]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("variant", "odometry", "records", "frames"),
    [("ids", 61945, 46860, 7122), ("detections", 61945, 52974, 7249), ("ascii", 61763, 52974, 7230)],
)
def test_victoria_park_counts(data_root, variant, odometry, records, frames):  # noqa: F811
    report = check_log(open_log(data_root / "victoria_park", variant=variant))
    streams = {stream.name: stream for stream in report.streams}
    assert streams["odometry"].records == odometry
    assert report.sightings.sightings == records
    assert streams["sightings"].instants == frames
    assert streams["fixes"].records == (948 if variant == "ascii" else 4466)
    assert report.verdict == "notes"


def test_victoria_park_identities(data_root):  # noqa: F811
    log = open_log(data_root / "victoria_park")
    report = check_log(log)
    assert (report.sightings.landmarks, report.sightings.unidentified) == (299, 0)
    batch, gps = log.references
    assert (batch.kind, batch.frame, len(batch.times), len(batch.landmarks)) == ("batch", "map", 6899, 299)
    assert (gps.kind, gps.frame, tuple(gps.point)) == ("gps", "other", (3.78, 0.5))
    frames = of_kind(log, Sightings)
    seen = set(np.concatenate([frame.ids for frame in frames]).tolist())
    assert seen == set(batch.landmark_ids.tolist())


def test_victoria_park_is_split_at_every_frame_and_loses_no_time(data_root):  # noqa: F811
    begin = time.process_time()
    events = list(open_log(data_root / "victoria_park"))
    assert time.process_time() - begin < 2.0
    in_order(events)
    blocks = [event for event in events if isinstance(event, Odometry)]
    assert sum(block.durations.sum() for block in blocks) == pytest.approx(1548.6, abs=1e-6)
    assert max(block.durations.sum() for block in blocks) <= 0.5 + 1e-5
    last = 21.94
    for event in events:
        if isinstance(event, Odometry):
            assert event.time == pytest.approx(last + event.durations.sum(), abs=1e-9)
            last = event.time
        elif isinstance(event, Sightings):
            assert event.time == last


def test_victoria_park_dead_reckoning_against_the_batch_solution(data_root):  # noqa: F811
    log = open_log(data_root / "victoria_park")
    times, poses = dead_reckoning(log)
    off = errors(times, poses, log.references[0])
    assert (rms(off), off.max(), off[-1]) == pytest.approx((154.6, 303.0, 201.3), abs=0.4)
    off = errors(
        *dead_reckoning(open_log(data_root / "victoria_park", variant="ascii")), log_batch(data_root)
    )
    assert (rms(off), off.max(), off[-1]) == pytest.approx((165.9, 364.4, 228.7), rel=0.01)


def log_batch(root):
    return open_log(root / "victoria_park", variant="ascii").references[0]


def test_victoria_park_detections_fit_the_batch_solution(data_root):  # noqa: F811
    """Bearings, sensor mount, identities, clock and batch frame all agree: the residuals are small."""
    log = open_log(data_root / "victoria_park")
    batch, sensor = log.references[0], log.defaults.sensor
    place = dict(zip(batch.landmark_ids.tolist(), batch.landmarks))
    pose_at = {round(t, 3): k for k, t in enumerate(batch.times.tolist())}
    ranges, bearings = [], []
    for frame in of_kind(log, Sightings):
        if (k := pose_at.get(round(frame.time, 3))) is None:
            continue
        heading = batch.headings[k]
        cos, sin = np.cos(heading), np.sin(heading)
        eye = batch.positions[k] + np.array([[cos, -sin], [sin, cos]]) @ [sensor.mount_x, sensor.mount_y]
        gap = np.array([place[i] for i in frame.ids.tolist()]) - eye
        ranges += (frame.values[:, 0] - np.hypot(*gap.T)).tolist()
        turned = frame.values[:, 1] - np.arctan2(gap[:, 1], gap[:, 0]) + heading
        bearings += ((turned + np.pi) % (2 * np.pi) - np.pi).tolist()
    assert len(ranges) > 44000
    assert np.median(np.abs(ranges)) * 1.4826 == pytest.approx(0.065, abs=0.01)
    assert np.median(np.abs(bearings)) * 1.4826 == pytest.approx(0.0028, abs=0.0005)


def test_victoria_park_raw_scans(data_root):  # noqa: F811
    log = open_log(data_root / "victoria_park", variant="scans")
    scans = of_kind(log, Scan)
    assert len(scans) == 7229  # the first of 7230 is earlier than the odometry
    first = scans[0]
    assert first.ranges.shape == first.bearings.shape == (361,)
    assert first.bearings[180] == pytest.approx(0.0, abs=1e-12)
    assert first.bearings[-1] == pytest.approx(np.pi / 2)
    finite = np.mean([np.isfinite(scan.ranges).mean() for scan in scans])
    assert finite == pytest.approx(0.17, abs=0.01)


def test_the_mat_file_alone_names_its_variant(data_root):  # noqa: F811
    folder = data_root / "victoria_park"
    log = open_log(folder / "VictoriaParkSinSincronizar.mat")
    frame = next(event for event in log if isinstance(event, Sightings))
    assert frame.ids is None and set(frame.attributes) == {"diameter"}
    assert log.defaults.association.method == "likelihood"
    identified = open_log(folder / "data_sensor_clean_clean.mat")
    assert next(e for e in identified if isinstance(e, Sightings)).ids is not None


def test_car_park_dead_reckoning_against_gps(data_root):  # noqa: F811
    log = open_log(data_root / "car_park")
    times, poses = dead_reckoning(log)
    steps = np.hypot(*np.diff(np.vstack([np.zeros(3), poses]), axis=0)[:, :2].T)
    assert steps.sum() == pytest.approx(199.4, abs=0.3)
    gps = log.references[0]
    assert (gps.kind, gps.frame, len(gps.times), gps.landmarks.shape) == ("gps+survey", "other", 626, (15, 2))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    a, b = gps.point
    point = poses[:, :2] + np.column_stack([a * cos - b * sin, a * sin + b * cos])
    inside = (gps.times >= times[0]) & (gps.times <= times[-1])
    path = np.column_stack([np.interp(gps.times[inside], times, point[:, k]) for k in (0, 1)])
    off = np.hypot(*(aligned(path, gps.positions[inside]) - gps.positions[inside]).T)
    assert (rms(off), off.max()) == pytest.approx((2.03, 6.89), abs=0.03)


def aligned(path, target):
    """`path` after the least-squares rotation and translation onto `target`."""
    a, b = path - path.mean(axis=0), target - target.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return a @ turn.T + target.mean(axis=0)


def test_car_park_poles(data_root):  # noqa: F811
    log = open_log(data_root / "car_park", detector=ReflectorDetector())
    frames = of_kind(log, Sightings)
    counts = [len(frame.values) for frame in frames]
    assert (len(frames), sum(counts), max(counts), counts.count(0)) == (586, 910, 5, 80)
    off = range_errors(frames, log.references[0])
    assert 840 <= len(off) <= 910
    assert abs(np.mean(off)) < 0.015 and np.std(off) < 0.06


def range_errors(frames, gps):
    """Measured less true range to the pole that each sighting belongs to, heading fitted per scan, m."""
    headings = np.linspace(-np.pi, np.pi, 721)
    found = []
    for frame in frames:
        if not len(frame.values):
            continue
        eye = np.array([np.interp(frame.time, gps.times, gps.positions[:, k]) for k in (0, 1)])
        angles = headings[:, None] + frame.values[:, 1]
        points = eye + frame.values[:, :1] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        gaps = np.linalg.norm(points[:, :, None] - gps.landmarks, axis=-1)
        best = np.minimum(gaps.min(axis=-1), 1.5).sum(axis=-1).argmin()
        pole, gap = gaps[best].argmin(axis=-1), gaps[best].min(axis=-1)
        true = np.linalg.norm(gps.landmarks[pole] - eye, axis=-1)
        found += (frame.values[:, 0] - true)[gap < 1.5].tolist()
    return np.array(found)


@pytest.mark.parametrize(("run", "robot", "landmarks", "unknown", "rows"), [
    (6, 1, 1534, 1, 61785), (6, 3, 4348, 2, 61158), (7, 3, 4425, 9, 55085), (7, 5, 3424, 0, 59787),
])  # fmt: skip
def test_mrclam_counts(data_root, run, robot, landmarks, unknown, rows):  # noqa: F811
    log = open_log(data_root / "mrclam" / f"MRCLAM_Dataset{run}", robot=robot)
    report = check_log(log)
    assert report.streams[0].records == rows
    assert report.sightings.sightings == landmarks + unknown
    assert report.sightings.unidentified == unknown
    assert report.verdict == "notes"


@pytest.mark.parametrize(("run", "robot", "expected"), [
    (6, 1, (2.62, 8.33, 8.33)), (6, 4, (1.84, 4.25, 3.16)), (7, 2, (2.04, 4.67, 3.75)),
])  # fmt: skip
def test_mrclam_dead_reckoning_from_the_true_start(data_root, run, robot, expected):  # noqa: F811
    log = open_log(data_root / "mrclam" / f"MRCLAM_Dataset{run}", robot=robot)
    truth = log.references[0]
    assert truth.frame == "map" and not log.start_covariance.any()
    times, poses = dead_reckoning(log)
    # Judged at the odometry's times, as the data set's description does.
    inside = times <= truth.times[-1]
    at = np.column_stack([np.interp(times[inside], truth.times, truth.positions[:, k]) for k in (0, 1)])
    off = np.hypot(*(poses[inside, :2] - at).T)
    assert (rms(off), off.max(), off[-1]) == pytest.approx(expected, rel=0.02)


def test_mrclam_without_capture(data_root):  # noqa: F811
    folder = data_root / "mrclam" / "MRCLAM_Dataset9"
    assert mrclam_robots(folder) == [1, 2, 3, 4, 5]
    log = open_log(folder)
    assert log.name == "mrclam-9-robot-1"
    assert (log.references[0].frame, len(log.references[0].times)) == ("other", 0)
    events = list(log)
    in_order(events)
    report = check_log(log)
    assert any("quirk" in finding.what for finding in report.findings)


def test_dlr_counts_and_odometry(data_root):  # noqa: F811
    log = open_log(data_root / "dlr")
    report = check_log(log)
    assert report.streams[0].records == 3297
    assert (report.sightings.sightings, report.sightings.landmarks) == (14620, 549)
    assert report.sightings.unidentified == 436
    batch = log.references[0]
    off = errors(*dead_reckoning(log), batch)
    assert (rms(off), off.max(), off[-1]) == pytest.approx((29.8, 59.4, 16.7), abs=0.1)
    first = next(event for event in log if isinstance(event, Odometry))
    assert first.values[0, 0] == pytest.approx(0.15647)  # forward was -Y
    assert np.linalg.eigvalsh(first.covariance).min() > 0


def test_dlr_original_text(data_root):  # noqa: F811
    report = check_log(open_log(data_root / "dlr" / "map.circles"))
    seen = report.sightings
    assert (seen.sightings, seen.landmarks, seen.unidentified, seen.empty_frames) == (14745, 576, 436, 84)


def test_dlr_sightings_fit_the_batch_solution(data_root):  # noqa: F811
    """Normalised squared residual about 0.69 a degree of freedom: Jacobian, frames and ids are right."""
    log = open_log(data_root / "dlr")
    batch = log.references[0]
    place = dict(zip(batch.landmark_ids.tolist(), batch.landmarks))
    total, count = 0.0, 0
    for frame in of_kind(log, Sightings):
        step = round(frame.time)
        for value, cov, i in zip(frame.values, frame.covariance, frame.ids.tolist()):
            if i < 0:
                continue
            gap = place[i] - batch.positions[step]
            off = value - [np.hypot(*gap), np.arctan2(gap[1], gap[0]) - batch.headings[step]]
            off[1] = (off[1] + np.pi) % (2 * np.pi) - np.pi
            total += off @ np.linalg.solve(cov, off)
            count += 2
    assert total / count == pytest.approx(0.69, abs=0.1)


def test_a_real_log_survives_the_csv_layout(data_root, tmp_path):  # noqa: F811
    log = open_log(data_root / "dlr")
    write_csv_log(log, tmp_path / "out")
    for a, b in zip(log, open_log(tmp_path / "out"), strict=True):
        assert type(a) is type(b) and a.time == b.time
        assert np.array_equal(a.values, b.values) and np.array_equal(a.covariance, b.covariance)
    park = open_log(data_root / "victoria_park")
    write_csv_log(park, tmp_path / "park")
    again = open_log(tmp_path / "park")
    assert again.defaults == park.defaults
    for a, b in zip(park, again, strict=True):
        assert type(a) is type(b) and a.time == b.time
        if not isinstance(a, Fix):
            assert np.array_equal(a.values, b.values)


@pytest.mark.parametrize(("name", "landmarks", "waypoints"), [
    ("example_webmap.mat", 35, 17), ("example_densermap.mat", 497, 17), ("example_loop1.txt", 22, 33),
])  # fmt: skip
def test_maps(data_root, name, landmarks, waypoints):  # noqa: F811
    world = read_map(data_root / "bailey_sim" / name)
    assert (world.landmarks.shape, world.waypoints.shape) == ((landmarks, 2), (waypoints, 2))
