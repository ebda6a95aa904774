"""A saved mixture goes on bit for bit with all of its explanations; a damaged or foreign file is refused."""

from __future__ import annotations

import numpy as np
import pytest

from damage import cuts, flipped, refused_cuts
from kalmap.association import Keep, KnownIds, Pmb
from kalmap.records import ConfigError, LogError, Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.mixture import MixtureSlam
from kalmap.slam.mixture_checkpoint import FORMAT
from slam_problems import XYSensor, circle_events, feed
from test_checkpoint import rewrite
from test_mixture_slam import METHOD, alone, cluttered, events_of, whole_state
from test_set_checkpoint import parts_of


@pytest.fixture(scope="module")
def closing() -> list:
    """The part of a drive in which a loop closes in clutter, from its beginning on."""
    return [event for event in events_of(cluttered(6)) if event.time <= 214.0]


def told(slam: MixtureSlam) -> dict:
    return {number: labels.tolist() for number, (labels, _) in slam.frame_revisions.items()}


@pytest.mark.parametrize("stop", [0.0, 100.01, 205.0, 206.51, 208.0, 211.0])
def test_a_resumed_run_is_the_same_bit_for_bit(closing, stop, tmp_path):
    """Oracle: the mixture that never stopped: states, weights, labels and what is revised after every later frame;
    saved before the first event, alone, between odometry and frame, and with several explanations alive."""
    slam = MixtureSlam(alone(cluttered(6)), 6)
    begin = [event for event in closing if event.time < stop]
    feed(slam, begin).save(tmp_path / "mixture")
    resumed = MixtureSlam.load(tmp_path / "mixture")
    assert whole_state(resumed) == whole_state(slam) and resumed.most == 6
    revised = 0
    for event in closing[len(begin) :]:
        slam.step(event)
        resumed.step(event)
        if isinstance(event, Sightings):
            assert told(resumed) == told(slam) and resumed.frame_labels.tolist() == slam.frame_labels.tolist()
            assert resumed.weights.tobytes() == slam.weights.tobytes()
            revised += len(told(slam))
    assert whole_state(resumed) == whole_state(slam) and revised >= 1
    assert resumed.estimate().covariance.tobytes() == slam.estimate().covariance.tobytes()
    labels = np.arange(slam._first.slam._founded)
    np.testing.assert_array_equal(resumed.settled_labels(labels), slam.settled_labels(labels))


def test_what_explanations_share_stands_once(closing, tmp_path):
    """Oracle: counted: frames before they parted are told once, those after by each of them."""
    slam = feed(MixtureSlam(alone(cluttered(6)), 6), [event for event in closing if event.time <= 208.0])
    slam.save(tmp_path / "mixture")
    header = parts_of((tmp_path / "mixture").read_bytes(), tmp_path / "mixture")[0]
    different = {id(entry) for each in slam._hypotheses for entry in each.past}
    assert len(slam._hypotheses) > 1 and len(header["told"]) == len(different)
    since = (
        slam.frames_taken - slam._begun
    )  # since there was one explanation alone; nothing before can change
    assert all(len(each.past) == since for each in slam._hypotheses) and since < 0.2 * slam.frames_taken
    assert since < len(different) < since * len(slam._hypotheses)
    resumed = MixtureSlam.load(tmp_path / "mixture")
    assert len({id(entry) for each in resumed._hypotheses for entry in each.past}) == len(different)


def test_parts_of_ones_own_are_refused(tmp_path):
    """Oracle: ConfigError, and no file."""
    with pytest.raises(ConfigError, match="not built in"):
        MixtureSlam(LandmarkSlam(sensor=XYSensor(np.eye(2)), association=METHOD)).save(tmp_path / "mixture")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "mixture"
    feed(MixtureSlam(LandmarkSlam(association=Pmb(management=Keep()))), circle_events(4, frames=4)).save(path)
    return path.read_bytes()


def test_damaged_files_are_refused(saved, tmp_path):
    """Oracle: LogError naming the file wherever it was cut; of a flipped byte LogError or exactly what was saved."""
    path, lengths = tmp_path / "mixture", cuts(saved, 97)
    assert refused_cuts(saved, path, MixtureSlam.load, lengths) == lengths
    flips = flipped(saved, path, lambda path: whole_state(MixtureSlam.load(path)), 11)
    assert flips.believed == []
    assert len(flips.refused) + len(flips.harmless) == len(range(0, len(saved), 11))
    assert len(flips.refused) > len(flips.harmless)


def test_headers_that_contradict_themselves_are_refused(closing, tmp_path):
    """Oracle: LogError naming the file."""
    path = tmp_path / "mixture"
    feed(MixtureSlam(alone(cluttered(6)), 6), [e for e in closing if e.time <= 208.0]).save(path)
    saved = path.read_bytes()
    one = parts_of(saved, path)[0]["explanations"][0]
    assert len(one["past"]) >= 2
    for change in (
        {"format": "kalmap-mixture/99"},
        {"most": 0},
        {"begun": 1},
        {"begun": -1},
        {"told": []},
        {"told": 3},
        {"explanations": []},
        {"explanations": [one | {"past": one["past"][:-1]}]},
        {"explanations": [one | {"past": [*one["past"], 0]}]},
        {"explanations": [one | {"past": [*one["past"][:-1], -1]}]},
        {"explanations": [one | {"log_weight": "nan"}]},
        {"explanations": [one | {"log_weight": "heavy"}]},
        {"explanations": [one | {"belief": None}]},
        {"explanations": [one, one | {"log_weight": (1.0).hex()}]},
        {"explanations": [one, one | {"filter": one["filter"] | {"time": (9.0).hex()}}]},
        {"explanations": [one | {"filter": one["filter"] | {"association": {"type": "KnownIds"}}}]},
        {"explanations": [one | {"filter": one["filter"] | {"ids": [1]}}]},
    ):
        rewrite(saved, path, header=change)
        with pytest.raises(LogError) as caught:
            MixtureSlam.load(path)
        assert caught.value.file == path
    rewrite(saved, path, header={"explanations": [one, one]})
    assert len(MixtureSlam.load(path).weights) == 2
    assert FORMAT == "kalmap-mixture/1"


def test_foreign_files_are_refused(tmp_path):
    """Oracle: LogError for a Kalman filter's file, and for a file that is not there."""
    LandmarkSlam(association=KnownIds()).save(tmp_path / "filter")
    for name in ("filter", "none"):
        with pytest.raises(LogError):
            MixtureSlam.load(tmp_path / name)
