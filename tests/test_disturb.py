"""False sightings added to a log: how many, where, and that the log's own are all still there."""

import math

import numpy as np
import pytest

from command import kalmap_inside
from kalmap.records import ConfigError, Sightings
from kalmap.simulate import simulate, with_clutter, world_by_name

LOG = simulate(world_by_name("course-35"), 1)


def frames(log):
    return [event for event in log if isinstance(event, Sightings)]


def test_every_sighting_is_still_there_and_the_false_ones_are_a_poisson_number():
    """Oracle: the log itself, and the Poisson law: mean and variance within five standard errors."""
    before, after = frames(LOG), frames(with_clutter(LOG, 4.0, 7))
    added = []
    for old, new in zip(before, after, strict=True):
        own = new.values[new.ids >= 0]
        assert sorted(map(tuple, own)) == sorted(map(tuple, old.values))
        assert sorted(new.ids[new.ids >= 0]) == sorted(old.ids)
        added.append((new.ids < 0).sum())
    count = len(added)
    assert np.mean(added) == pytest.approx(4.0, abs=5.0 * 2.0 / math.sqrt(count))
    assert np.var(added) == pytest.approx(4.0, abs=5.0 * 4.0 * math.sqrt(2.2 / count))


def test_they_are_uniform_over_what_the_sensor_sees():
    """Oracle: the uniform law's mean and largest value."""
    false = np.concatenate([frame.values[frame.ids < 0] for frame in frames(with_clutter(LOG, 4.0, 7))])
    assert false[:, 0].min() > 0.0 and 29.9 < false[:, 0].max() <= 30.0
    assert false[:, 0].mean() == pytest.approx(15.0, abs=5.0 * 8.66 / math.sqrt(len(false)))
    assert abs(false[:, 1]).max() <= math.pi / 2
    assert false[:, 1].mean() == pytest.approx(0.0, abs=5.0 * 0.907 / math.sqrt(len(false)))


def test_the_seed_says_it_all_and_a_log_can_be_read_again():
    log = with_clutter(LOG, 2.0, 3)
    for first, second in zip(frames(log), frames(log), strict=True):
        np.testing.assert_array_equal(first.values, second.values)
    assert log.settings["clutter"] == {"mean": 2.0, "seed": 3}
    assert any(len(a.values) != len(b.values) for a, b in zip(frames(log), frames(with_clutter(LOG, 2.0, 4))))


def test_none_is_none_and_too_many_are_refused():
    for old, new in zip(frames(LOG), frames(with_clutter(LOG, 0.0, 1)), strict=True):
        assert sorted(map(tuple, new.values)) == sorted(map(tuple, old.values))
    with pytest.raises(ConfigError, match="clutter"):
        with_clutter(LOG, -1.0, 1)
    with pytest.raises(ConfigError, match="clutter"):
        with_clutter(LOG, 1e4, 1)


def test_from_the_command_line(tmp_path):
    out = tmp_path / "out"
    arguments = ["run", "course-35", "--clutter", "3", "--method", "pmbm", "--set", "world.laps=1"]
    answer = kalmap_inside(*arguments, "--no-figures", "--quiet", "--out", out)
    assert answer.code == 0, answer.err
    assert (out / "manifest.json").read_text().count('"mean": 3.0') == 1
