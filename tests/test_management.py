"""Who is believed in: tables worked out by hand, Bayes' rule written out, and the bookkeeping in a running filter."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from kalmap.association import Counter, Djnn, Existence, Keep, Likelihood, Nearest, Trial
from kalmap.association.management import Review, Verdict
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import AssociationConfig, Odometry, Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.build import associator_from_config
from slam_problems import circle_events, copy_belief

REACH = 30.0


def review(seen, expected=None, ranges=None, believed=False) -> Review:
    """Landmarks 0, 1, ... of a frame."""
    seen = np.array(seen, bool)
    return Review(
        np.arange(len(seen)),
        seen,
        np.ones(len(seen), bool) if expected is None else np.array(expected, bool),
        np.broadcast_to(np.array(believed, bool), seen.shape),
        np.full(len(seen), 10.0) if ranges is None else np.array(ranges, float),
        REACH,
    )


def play(management, frames, expected=None, distance=10.0, believed=False):
    """One landmark through frames of seen (1) or not (0), until it is retired: [(score, what happened)]."""
    score, confirmed, extra, told = (
        management.first_score,
        believed or not management.tries,
        management.start(),
        [],
    )
    for k, seen in enumerate(frames):
        view = [True] if expected is None else [expected[k]]
        frame = review([seen], view, [distance], confirmed)
        verdict = management.review([score], [confirmed], extra, frame)
        management.settle(extra, verdict.extra)
        score = dict(verdict.scores).get(0, score)
        what = "confirmed" if verdict.confirmed else "retired" if verdict.retired else ""
        confirmed |= what == "confirmed"
        told.append((score, what))
        if what == "retired":
            break
    return told


def whats(told) -> list[str]:
    return [what for _, what in told]


def test_keep_believes_at_once_and_for_ever():
    """Oracle: by hand: no verdict, whatever comes."""
    assert not Keep().tries and Keep().existence(Keep().first_score) == 1.0
    assert Keep().review([1.0], [True], [], review([0])) == Verdict()


# --- trial --------------------------------------------------------------------------------------------

TRIALS = {
    # name: (confirm, window, seen, expected, what happens); the founding frame is sighting 1 and frame 1
    "two of three": (2, 3, [0, 1], None, ["", "confirmed"]),
    "out of frames": (2, 3, [0, 0], None, ["", "retired"]),
    "the last frame counts": (3, 4, [1, 0, 1], None, ["", "", "confirmed"]),
    "seen at the end but too seldom": (3, 3, [0, 1], None, ["", "retired"]),
    "out of view nothing counts": (2, 3, [0, 0, 0, 0, 1], [1, 0, 0, 0, 0], ["", "", "", "", "confirmed"]),
    "out of view and then lost": (2, 3, [0, 0, 0, 0], [1, 0, 0, 1], ["", "", "", "retired"]),
    "once is enough": (1, 1, [0, 0], None, ["", ""]),
}


@pytest.mark.parametrize("name", TRIALS)
def test_trials_by_hand(name):
    """Oracle: sightings and frames counted on fingers."""
    confirm, window, seen, expected, what = TRIALS[name]
    management = Trial(confirm=confirm, window=window)
    assert management.tries == (confirm > 1)
    assert whats(play(management, seen, expected)) == what


@pytest.mark.parametrize("window", [30, 1023, 1024, 5000])
def test_long_windows_stay_exact(window):
    """Oracle: integers: after window - 1 frames in view without a sighting it is gone, not one frame sooner or later,
    and no sighting was ever made of frames."""
    told = play(Trial(confirm=2, window=window), [0] * (window + 5))
    assert len(told) == window - 1 and told[-1][1] == "retired"
    told = play(Trial(confirm=3, window=window), [0] * (window - 3) + [1, 1])
    assert whats(told)[-1] == "confirmed" and len(told) == window - 1


def test_confirmed_landmarks_are_on_trial_no_more():
    """Oracle: by hand: no score changes, and nobody is retired."""
    verdict = Trial(confirm=2, window=2).review([9.0, 1.001], [True, False], [], review([0, 0]))
    assert [index for index, _ in verdict.scores] == [1]
    assert [index for index, _ in verdict.retired] == [1]


# --- the paper's counter ------------------------------------------------------------------------------

COUNTS = {
    # name: (seen, expected, the paper's T after each frame, what happens); T is 1 when it is founded
    "twice in a row": ([1], None, [2], ["confirmed"]),
    "once and never again": ([0], None, [0], ["retired"]),
    "out of view it stays": ([0, 0, 1], [0, 0, 1], [1, 1, 2], ["", "", "confirmed"]),
    "seen where it was not expected": ([1], [0], [2], ["confirmed"]),
    "confirmed, and gone from the map": ([1, 0, 0], None, [2, 1, 0], ["confirmed", "", "retired"]),
    "confirmed, lost and found": ([1, 0, 1, 0, 1], None, [2, 1, 2, 1, 2], ["confirmed", "", "", "", ""]),
}


@pytest.mark.parametrize("name", COUNTS)
def test_the_counter_is_equation_9(name):
    """Oracle: the sum of equation (9) by hand: admit at 2, remove at 0, also from the map."""
    seen, expected, counter, what = COUNTS[name]
    told = play(Counter(), seen, expected)
    assert [score for score, _ in told] == counter and whats(told) == what


def test_the_counters_bounds_are_settings():
    """Oracle: by hand: admitted at 4; removed at -1."""
    assert whats(play(Counter(admit=4), [1, 1, 1])) == ["", "", "confirmed"]
    assert whats(play(Counter(expel=-1), [0, 0])) == ["", "retired"]
    assert not Counter(admit=1).tries and Counter(admit=2).tries


@pytest.mark.parametrize("name", ["counter", "existence"])
def test_a_configuration_says_what_detection_is_learned_from(name):
    """Oracle: by hand: nothing seen yet, so the assumed probability itself."""
    config = AssociationConfig(method="nearest", management=name, detection=0.6)
    management = associator_from_config(config).management
    assert management.detection_at(management.start(), 12.0, REACH) == pytest.approx(0.6)


def test_detection_is_learned_by_range():
    """Oracle: the share of a prior of 20 frames at 0.9 and of what was seen in the bin, by hand; six bins of 5 m."""
    management = Counter()
    extra = management.start()
    assert len(extra) == 6
    confirmed = [True, True, False]
    for _ in range(10):  # at 12 m always, at 26 m never, at 3 m on trial: it says nothing about detection
        frame = review([1, 0, 1], None, [12.0, 26.0, 3.0], confirmed)
        verdict = management.review([9.0] * 3, confirmed, extra, frame)
        management.settle(extra, verdict.extra)
    assert extra == [[0, 0], [0, 0], [10, 10], [0, 0], [0, 0], [0, 10]]
    at = [management.detection_at(extra, distance, REACH) for distance in (3.0, 12.0, 26.0, 29.9, 35.0)]
    np.testing.assert_allclose(at, [0.9, 28 / 30, 18 / 30, 18 / 30, 18 / 30])
    extra[5] = [0.0, 1e6]
    extra[2] = [1e6, 1e6]
    assert management.detection_at(extra, 26.0, REACH) == 0.05
    assert management.detection_at(extra, 12.0, REACH) == 0.98


def test_misses_at_ranges_where_little_is_seen_do_not_count():
    """Oracle: by hand: with 18 sightings in 37 frames the share is below one half: T stays; with 36 it falls."""
    management = Counter()
    for frames, score in ((15.9, 8.0), (16.1, None)):
        extra = management.start()
        extra[5] = [0.0, frames]  # (0 + 18) / (frames + 20)
        verdict = management.review([9.0], [True], extra, review([0], None, [28.0]))
        assert dict(verdict.scores).get(0) == score


@pytest.mark.parametrize("management", [Counter(), Existence()])
def test_what_a_frame_teaches(management):
    """Oracle: numpy's histogram over the landmarks that are believed in and expected; the others teach nothing."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(0, 20))
        seen, expected, believed = (rng.random((3, count)) < 0.6).tolist()
        ranges = rng.uniform(0.0, 1.2 * REACH, count)
        frame = review(seen, expected, ranges, believed)
        extra = management.start()
        verdict = management.review([9.0] * count, believed, extra, frame)
        management.settle(extra, verdict.extra)
        counts = np.array(believed, bool) & np.array(expected, bool)
        edges = np.r_[np.arange(6) * REACH / 6, np.inf]
        wanted = [np.histogram(ranges[counts & np.array(also, bool)], edges)[0] for also in (seen, expected)]
        np.testing.assert_array_equal(np.array(extra), np.array(wanted).T)


# --- existence ----------------------------------------------------------------------------------------


def bayes(p: float, seen: bool, detection: float, false: float) -> float:
    """Posterior probability that the landmark is there, Bayes' rule written out."""
    there = detection if seen else 1.0 - detection
    not_there = false if seen else 1.0 - false
    return p * there / (p * there + (1.0 - p) * not_there)


@pytest.mark.parametrize("seed", range(5))
def test_existence_is_bayes_rule(seed):
    """Oracle: the recursion on probabilities; log-odds must say the same."""
    rng = np.random.default_rng(seed)
    management = Existence(detection=0.7, false_rate=0.2, prior=0.4, admit=1.0 - 1e-12, expel=0.0, most=40.0)
    frames = (rng.random(15) < 0.6).astype(int).tolist()
    p, expected = 0.4, []
    for seen in frames:
        p = bayes(p, bool(seen), 0.7, 0.2)
        expected.append(p)
    told = play(management, frames)
    np.testing.assert_allclose([management.existence(score) for score, _ in told], expected, rtol=1e-9)
    np.testing.assert_allclose(management.existence(management.first_score), 0.4)


def test_existence_admits_and_expels_at_its_probabilities():
    """Oracle: Bayes' rule, with the defaults: 0.3, 0.79, 0.97 and out at the first miss."""
    default = Existence()
    told = play(default, [1, 1])
    first, second = bayes(0.3, True, 0.9, 0.1), bayes(bayes(0.3, True, 0.9, 0.1), True, 0.9, 0.1)
    assert first < 0.97 <= second and whats(told) == ["", "confirmed"]
    assert bayes(0.3, False, 0.9, 0.1) < 0.1 and whats(play(default, [0])) == ["retired"]
    assert whats(play(default, [0, 1, 1], [0, 1, 1])) == [
        "",
        "",
        "confirmed",
    ]  # out of view: nothing is learned
    assert default.tries and not Existence(prior=0.99).tries


def test_existence_notices_what_left_after_long_standing():
    """Oracle: the cap of 12 and steps of ln(0.1 / 0.9) at first: gone after some misses, however long it stood."""
    management = Existence(most=12.0)
    told = play(management, [1] * 300 + [0] * 40)
    assert max(score for score, _ in told) == 12.0
    assert told[-1][1] == "retired" and len(told) < 320
    for score in (-1e3, -50.0, 0.0, 50.0, 1e3):
        assert 0.0 <= management.existence(score) <= 1.0


def test_existence_without_expelling_stays_a_number():
    """Oracle: by hand: what is never expelled is bounded below as it is above, and comes back: -5 and four steps of
    ln 9 are the first above ln(0.97 / 0.03) = 3.48."""
    told = play(Existence(expel=0.0, most=5.0), [0] * 2000 + [1] * 4)
    assert min(score for score, _ in told) == -5.0
    assert whats(told) == [""] * 2003 + ["confirmed"]


def test_existence_with_hardly_any_detection():
    """Oracle: P_F stays below P_D, so that a sighting always speaks for a landmark and a miss against it."""
    management = Existence(false_rate=0.9)
    extra = management.start()
    extra[2] = [0.0, 1e6]
    for seen, sign in ((1, 1), (0, -1)):
        verdict = management.review([0.0], [False], extra, review([seen], None, [12.0]))
        assert math.copysign(1.0, verdict.scores[0][1]) == sign


# --- in a filter --------------------------------------------------------------------------------------


def clutter(seed: int, frames: int = 40) -> list:
    """The circle drive with three false sightings in every second frame."""
    rng, events = np.random.default_rng(seed), []
    for number, event in enumerate(circle_events(seed, frames)):
        if isinstance(event, Sightings) and number % 4 == 1:
            false = np.c_[rng.uniform(3, 25, 3), rng.uniform(-1.2, 1.2, 3)]
            event = Sightings(event.time, np.vstack([false, event.values]), np.r_[-1, -1, -1, event.ids])
        events.append(event)
    return events


MANAGEMENTS = {
    "keep": Keep(), "trial": Trial(confirm=3, window=5), "counter": Counter(), "existence": Existence(),
}  # fmt: skip


@pytest.mark.parametrize("method", [Nearest, Likelihood, Djnn])
@pytest.mark.parametrize("name", MANAGEMENTS)
def test_lists_stay_aligned_however_many_are_removed(method, name):
    """Oracle: a dictionary kept beside the run by lasting numbers: who is confirmed, which score, in which order."""
    slam = LandmarkSlam(association=method(management=MANAGEMENTS[name]))
    scores, sure, most = {}, set(), 0
    for event in clutter(5):
        ids = list(slam._ids)
        slam.step(event)
        if isinstance(event, Odometry):
            continue
        association, memory = slam.frame_association, slam._memory
        verdict = association.change.verdict
        fresh = [i for i in range(slam._founded) if i not in scores]
        scores |= dict.fromkeys(fresh, MANAGEMENTS[name].first_score)
        scores |= {ids[index]: score for index, score in verdict.scores}
        sure |= {ids[index] for index in association.confirmed}
        sure |= set() if MANAGEMENTS[name].tries else set(fresh)
        ids = [i for k, i in enumerate(ids) if k not in association.retired] + fresh
        assert slam._ids == memory["serial"] == ids
        assert len(slam._counts) == (slam._belief.n - slam._belief.robot) // 2 == len(ids)
        assert memory["score"] == [scores[i] for i in ids]
        assert memory["confirmed"] == [i in sure for i in ids]
        assert slam._on_trial == set(ids) - sure
        assert slam.association.fits(memory, len(ids)) and not slam.association.fits(memory, len(ids) + 1)
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(memory)) == memory
        most = max(most, len(association.retired))
    assert most >= 2 or name == "keep"
    landmarks = slam.estimate().landmarks
    assert set(landmarks.ids.tolist()) == sure & set(slam._ids)
    assert ((landmarks.existence == 1.0).all()) == (name != "existence")
    assert (landmarks.existence > 0.1).all()


def test_removal_of_several_marginalises_exactly():
    """Oracle: the belief before the frame, updated by a twin, with the rows of the retired deleted by numpy."""
    slam = LandmarkSlam(
        VelocitySteering(), RangeBearing(max_range=100.0), association=Nearest(management=Trial(2, 2))
    )
    slam.step(Odometry(0.0, np.array([[1.0, 0.1]]), np.array([0.1])))
    z = np.array([[10.0, 0.5], [12.0, -0.5], [20.0, 0.0], [25.0, 0.3], [16.0, 0.9]])
    slam.step(Sightings(0.0, z))
    slam.step(Odometry(1.0, np.array([[1.0, 0.1]]), np.array([0.1])))
    twin = copy_belief(slam._belief)
    seen = z[[1, 4]] - (0.1, 0.0)
    slam.step(Sightings(1.0, seen))
    assert slam.frame_association.retired == (0, 2, 3) and slam.rejected == {0, 2, 3}
    slam._engine.update(twin, seen, np.array([5, 11]), slam.sensor.covariance(seen))
    kept = [0, 1, 2, 5, 6, 11, 12]
    mean, covariance = slam.estimate().joint()
    np.testing.assert_array_equal(mean, twin.mean[kept])
    np.testing.assert_array_equal(covariance, twin.covariance()[np.ix_(kept, kept)])
