"""The run loop: what is kept, listed and labelled, whatever happens on the way."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.association import Likelihood
from kalmap.records import (
    ConfigError,
    EstimationError,
    Fix,
    Log,
    LogError,
    Odometry,
    RunConfig,
    Sightings,
    Skipped,
)
from kalmap.slam import LandmarkSlam, run
from kalmap.slam.run import KEPT_SKIPS
from slam_problems import XYSensor, circle_events, feed, log_of

EVENTS = circle_events(1, frames=20)
BAD = Sightings(EVENTS[7].time, np.array([[-1.0, 0.0]]), np.array([0]), record=77)
LATE = Odometry(0.1, np.array([[1.0, 0.0]]), np.array([0.1]), record=88)


def test_a_clean_run_gives_what_stepping_gives():
    """Oracle: the same filter stepped by hand."""
    outcome = run(LandmarkSlam(), log_of(EVENTS))
    by_hand = feed(LandmarkSlam(), EVENTS)
    assert outcome.error is None and not outcome.interrupted and outcome.skipped_total == 0
    np.testing.assert_array_equal(outcome.estimate.joint()[1], by_hand.estimate().joint()[1])
    assert outcome.frames == 20
    assert outcome.sightings == sum(len(e.values) for e in EVENTS if isinstance(e, Sightings))


def test_trace_shapes_and_contents():
    """Oracle: the shapes of Trace's docstring; one row an instant, a frame replacing its odometry's row."""
    trace = run(LandmarkSlam(), log_of(EVENTS)).trace
    rows, samples = 20, 80
    assert trace.poses.shape == (rows, 3) and trace.covariances.shape == (rows, 3, 3)
    for column in (trace.times, trace.nis, trace.nis_dof, trace.landmarks, trace.sightings):
        assert column.shape == (rows,)
    assert trace.step_seconds.shape == trace.step_times.shape == (samples,)
    np.testing.assert_allclose(trace.step_times, 0.1 * np.arange(1, samples + 1), atol=1e-9)
    np.testing.assert_array_equal(trace.times, [e.time for e in EVENTS[1::2]])
    assert (trace.step_seconds > 0).all() and (np.diff(trace.landmarks) >= 0).all()
    np.testing.assert_array_equal(np.isnan(trace.nis), trace.sightings == 0)
    np.testing.assert_array_equal(trace.nis_dof, 2 * trace.sightings)
    assert 0.3 < np.nansum(trace.nis) / trace.nis_dof.sum() < 2.0


def test_empty_log():
    """Oracle: arrays of no rows in the right shapes."""
    outcome = run(LandmarkSlam(), log_of([]))
    assert outcome.trace.poses.shape == (0, 3) and outcome.trace.covariances.shape == (0, 3, 3)
    assert outcome.dead_reckoning[1].shape == (0, 3) and outcome.frames == 0


def test_tolerant_run_skips_lists_and_goes_on():
    """Oracle: the run over the log without the bad records."""
    outcome = run(LandmarkSlam(), log_of([*EVENTS[:8], BAD, LATE, *EVENTS[8:]]), tolerant=True)
    clean = run(LandmarkSlam(), log_of(EVENTS))
    assert outcome.error is None and outcome.skipped_total == 2
    assert [(s.file, s.record, s.field) for s in outcome.skipped] == [
        ("memory", 77, "range"),
        ("memory", 88, "time"),
    ]
    np.testing.assert_array_equal(outcome.estimate.joint()[0], clean.estimate.joint()[0])
    np.testing.assert_array_equal(outcome.trace.covariances, clean.trace.covariances)
    assert outcome.frames == clean.frames


def test_skips_of_the_reader_are_counted_and_the_list_is_bounded():
    """Oracle: the number of skips that the log's reader reports."""

    def open_log(skip):
        for k in range(KEPT_SKIPS + 5):
            skip(Skipped(file="f", record=k, field="x", problem="bad"))
        yield from EVENTS

    outcome = run(
        LandmarkSlam(), Log(name="t", source="f", defaults=RunConfig(), open=open_log), tolerant=True
    )
    assert outcome.skipped_total == KEPT_SKIPS + 5 and len(outcome.skipped) == KEPT_SKIPS


@pytest.mark.parametrize(("event", "field", "record"), [(BAD, "range", 77), (LATE, "time", 88)])
def test_an_error_names_the_place_and_keeps_what_was_computed(event, field, record):
    """Oracle: the run that ends just before the bad record."""
    outcome = run(LandmarkSlam(), log_of([*EVENTS[:8], event, *EVENTS[8:]]))
    short = run(LandmarkSlam(), log_of(EVENTS[:8]))
    assert isinstance(outcome.error, LogError)
    assert (outcome.error.file, outcome.error.record, outcome.error.field) == ("memory", record, field)
    assert outcome.frames == short.frames == 4
    np.testing.assert_array_equal(outcome.trace.poses, short.trace.poses)
    np.testing.assert_array_equal(outcome.estimate.joint()[1], short.estimate.joint()[1])


def test_an_estimation_error_ends_even_a_tolerant_run():
    """Oracle: EstimationError with the step's number; a broken filter is no bad record."""
    wrong = Sightings(
        EVENTS[7].time, EVENTS[7].values, EVENTS[7].ids, np.tile(-1e6 * np.eye(2), (len(EVENTS[7].ids), 1, 1))
    )
    outcome = run(LandmarkSlam(), log_of([*EVENTS[:8], wrong, *EVENTS[8:]]), tolerant=True)
    assert isinstance(outcome.error, EstimationError) and "step 16" in str(outcome.error)
    assert outcome.frames == 4 and len(outcome.trace.times) == 4


@pytest.mark.parametrize("stop", [0, 1, 9])
def test_interrupt_keeps_what_there_is(stop):
    """Oracle: the run over the events before the interrupt."""

    def open_log(skip):
        yield from EVENTS[:stop]
        raise KeyboardInterrupt

    outcome = run(LandmarkSlam(), Log(name="t", source="f", defaults=RunConfig(), open=open_log))
    short = run(LandmarkSlam(), log_of(EVENTS[:stop]))
    assert outcome.interrupted and outcome.error is None
    np.testing.assert_array_equal(outcome.trace.poses, short.trace.poses)
    np.testing.assert_array_equal(outcome.estimate.pose, short.estimate.pose)


def test_errors_of_the_reader_end_the_run_with_what_there_is():
    """Oracle: the reader's own error object; an error that is not kalmap's passes through."""
    problem = LogError("torn", file="f", record=3)

    def broken(error):
        yield from EVENTS[:4]
        raise error

    outcome = run(
        LandmarkSlam(), Log(name="t", source="f", defaults=RunConfig(), open=lambda skip: broken(problem))
    )
    assert outcome.error is problem and outcome.frames == 2
    with pytest.raises(ZeroDivisionError):
        run(
            LandmarkSlam(),
            Log(name="t", source="f", defaults=RunConfig(), open=lambda skip: broken(ZeroDivisionError())),
        )


def test_labels_and_truth_of_an_association_that_decides():
    """Oracle: the log's own identities: on an easy drive a label always means the same identity."""
    outcome = run(LandmarkSlam(association=Likelihood()), log_of(EVENTS))
    assert len(outcome.truth_ids) == len(outcome.labels) == outcome.sightings
    np.testing.assert_array_equal(outcome.truth_ids, np.concatenate([e.ids for e in EVENTS[1::2]]))
    np.testing.assert_array_equal(outcome.values, np.concatenate([e.values for e in EVENTS[1::2]]))
    np.testing.assert_array_equal(
        outcome.times, np.repeat([e.time for e in EVENTS[1::2]], [len(e.ids) for e in EVENTS[1::2]])
    )
    assert 0.0 < outcome.association_seconds < outcome.runtime
    used = outcome.labels >= 0
    pairs = set(zip(outcome.truth_ids[used].tolist(), outcome.labels[used].tolist(), strict=True))
    assert used.mean() > 0.95 and len(pairs) == len(outcome.estimate.landmarks)


def test_no_labels_where_association_is_given_or_the_truth_unknown():
    """Oracle: Outcome's docstring."""
    outcome = run(LandmarkSlam(), log_of(EVENTS))
    assert [len(a) for a in (outcome.labels, outcome.truth_ids, outcome.times, outcome.values)] == [0] * 4
    outcome = run(LandmarkSlam(association=Likelihood()), log_of(EVENTS, truth_ids=False))
    assert len(outcome.labels) == outcome.sightings and len(outcome.truth_ids) == 0


def test_a_frame_without_identities_keeps_the_others_in_place():
    """Oracle: the log's identities, -1 for those of the frame that lost them; none at all where all frames did."""
    nameless = [
        Sightings(e.time, e.values) if isinstance(e, Sightings) and k in (1, 9) else e
        for k, e in enumerate(EVENTS)
    ]
    outcome = run(LandmarkSlam(association=Likelihood()), log_of(nameless))
    truth = [np.full(len(e.values), -1) if e.ids is None else e.ids for e in nameless[1::2]]
    np.testing.assert_array_equal(outcome.truth_ids, np.concatenate(truth))
    bare = [Sightings(e.time, e.values) if isinstance(e, Sightings) else e for e in EVENTS]
    assert len(run(LandmarkSlam(association=Likelihood()), log_of(bare)).truth_ids) == 0


def test_a_second_run_counts_its_own_seconds():
    """Oracle: the filter's own clock, which goes on: the two runs' shares add up to it."""
    slam = LandmarkSlam(association=Likelihood())
    first, second = run(slam, log_of(EVENTS[:20])), run(slam, log_of(EVENTS[20:]))
    assert first.association_seconds > 0.0 and second.association_seconds > 0.0
    both = first.association_seconds + second.association_seconds
    assert both == pytest.approx(slam.association_seconds, rel=1e-12)


def test_dead_reckoning_is_odometry_alone():
    """Oracle: Bailey's Euler steps of the logged controls, written out."""
    times, poses = run(LandmarkSlam(), log_of(EVENTS)).dead_reckoning
    pose, expected = np.zeros(3), []
    for event in EVENTS[::2]:
        for (v, g), dt in zip(event.values, event.durations, strict=True):
            pose = pose + dt * v * np.array([np.cos(g + pose[2]), np.sin(g + pose[2]), np.sin(g) / 4.0])
        expected.append(pose)
    np.testing.assert_array_equal(times, [e.time for e in EVENTS[::2]])
    np.testing.assert_allclose(poses[:, :2], np.array(expected)[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * poses[:, 2]), np.exp(1j * np.array(expected)[:, 2]), atol=1e-9)
    assert run(LandmarkSlam(), log_of(EVENTS), reckon=False).dead_reckoning is None


def test_fixes_are_passed_over_and_progress_is_told():
    """Oracle: the run without fixes."""
    with_fixes = [e for event in EVENTS for e in (event, Fix(event.time, 1e6, 1e6))]
    told: list[float] = []
    outcome = run(LandmarkSlam(), log_of(with_fixes), progress=told.append)
    np.testing.assert_array_equal(outcome.trace.poses, run(LandmarkSlam(), log_of(EVENTS)).trace.poses)
    assert told and told == sorted(told)


class OwnMotion:
    """A user's motion model: (metres ahead, radians turned)."""

    compiled, control_size, biases = False, 2, ()

    def increment(self, control, biases, dt):
        return np.stack([control[..., 0], 0.0 * control[..., 0], control[..., 1]], axis=-1)

    def control_covariance(self, control, dt):
        return np.diag([0.01, 0.001])


def test_user_models_run_and_are_not_saved(tmp_path):
    """Oracle: Outcome: odometry alone is known for built-in motion only; saving is refused by name."""
    slam = LandmarkSlam(OwnMotion(), XYSensor(np.eye(2)))
    outcome = run(slam, log_of(EVENTS[:1]))
    assert outcome.error is None and outcome.dead_reckoning is None
    assert len(outcome.trace.times) == 1
    with pytest.raises(ConfigError, match="not built in"):
        slam.save(tmp_path / "never-written")
    assert list(tmp_path.iterdir()) == []
