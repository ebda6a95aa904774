"""The cheapest explanation of a window of frames, against every explanation there is and by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from kalmap.association import Attribute, Mda
from kalmap.association import mda as mda_module
from kalmap.association.mda import UNUSED, Glance
from kalmap.geometry.ellipses import chi_square_2
from kalmap.records import NEW, SPURIOUS, ConfigError, Reason, Sightings
from test_association import Fake, decide, frame, memory_of

VIEW = SimpleNamespace(max_range=30.0, half_view=0.5 * np.pi)
GATE, NEW_GATE = chi_square_2(0.99), chi_square_2(0.999)

# --- random windows and every explanation of them -------------------------------------------------


def random_glances(rng: np.random.Generator, frames: int, most: int) -> list[Glance]:
    """Frames of 0 to `most` sightings and some of three old landmarks; one founded within the window stands by."""
    counts = [min(most, int(n)) for n in rng.integers(0, most + 3, frames)]
    glances = []
    for f, count in enumerate(counts):
        numbers = np.array([n for n in (2, 5, 6, 9) if rng.random() < 0.6], dtype=np.int64)
        shape = (count, len(numbers))
        glances.append(
            Glance(
                numbers=numbers,
                squared=rng.exponential(12.0, shape),
                log_volume=rng.normal(-4.0, 2.0, shape),
                trial=rng.random(len(numbers)) < 0.5,
                missed=np.where(rng.random(len(numbers)) < 0.7, rng.uniform(0.5, 3.0), 0.0),
                founded=8 + 2 * f,
                gate=GATE,
                new_gate=NEW_GATE,
                links=tuple(
                    (rng.exponential(5.0, (before, count)), rng.normal(-4.0, 2.0, (before, count)))
                    for before in counts[:f]
                ),
            )
        )
    return glances


def random_mda(rng: np.random.Generator, frames: int) -> Mda:
    rates = rng.uniform(0.1, 5.0, 2)
    return Mda(window=frames, detection=rng.uniform(0.3, 0.95), false_rate=rates[0], new_rate=rates[1])


def landmarks_of(glances: list[Glance]) -> set[int]:
    """Those that stood before the window began."""
    return {n for glance in glances for n in glance.numbers.tolist() if n < glances[0].founded}


def cost_of(mda: Mda, glances: list[Glance], keys: list[list]) -> float:
    """-ln of the likelihood ratio of an explanation against no landmark seen and every sighting false; inf for none.

    The density of a sighting of a landmark is P_D N(nu; 0, S), of a false one lambda_F over the view, of the first
    of a new landmark lambda_N over the view.
    """
    area = VIEW.max_range * 2.0 * VIEW.half_view
    likelihood = 1.0

    def seen(squared: float, log_volume: float) -> float:
        normal = math.exp(-0.5 * squared) / (2.0 * math.pi * math.sqrt(math.exp(log_volume)))
        return mda.detection * normal / (mda.false_rate / area)

    for f, glance in enumerate(glances):
        for column, number in enumerate(glance.numbers.tolist()):
            if number not in landmarks_of(glances):
                continue
            rows = [i for i, key in enumerate(keys[f]) if key == (-1, number)]
            if rows:
                likelihood *= seen(glance.squared[rows[0], column], glance.log_volume[rows[0], column])
                likelihood /= math.exp(-glance.missed[column])  # what was counted for a miss
    for first, i in {key for row in keys for key in row if key[0] >= 0}:
        likelihood *= mda.new_rate / mda.false_rate
        for later in range(first + 1, len(glances)):
            rows = [m for m, key in enumerate(keys[later]) if key == (first, i)]
            link = glances[later].links[first]
            likelihood *= seen(link[0][i, rows[0]], link[1][i, rows[0]]) if rows else 1.0 - mda.detection
    return -math.log(likelihood)


def options_of(glances: list[Glance], f: int, i: int, keys: list[list]) -> list:
    """What sighting i of frame f may be, given what was said of those before it."""
    glance, taken = glances[f], set(keys[f])
    options = [UNUSED]
    believed_near = False
    for column, number in enumerate(glance.numbers.tolist()):
        if number not in landmarks_of(glances):
            continue
        if glance.squared[i, column] <= GATE and (-1, number) not in taken:
            options.append((-1, number))
        believed_near |= bool(not glance.trial[column] and glance.squared[i, column] < NEW_GATE)
    for first in range(f):
        for m, key in enumerate(keys[first]):
            if key == (first, m) and key not in taken and glance.links[first][0][m, i] <= GATE:
                options.append(key)
    if not believed_near and f < len(glances) - 1:
        options.append((f, i))
    return options


def explanations(glances: list[Glance], keys: list[list] | None = None):
    """Every explanation: tracks seen once are left out."""
    keys = [[]] if keys is None else keys
    if len(keys[-1]) == glances[len(keys) - 1].count:
        if len(keys) < len(glances):
            yield from explanations(glances, [*keys, []])
            return
        every = [key for row in keys for key in row if key[0] >= 0]
        if all(every.count(key) > 1 for key in every):
            yield keys
        return
    for option in options_of(glances, len(keys) - 1, len(keys[-1]), keys):
        yield from explanations(glances, [*keys[:-1], [*keys[-1], option]])


@pytest.mark.parametrize("block", range(5))
@pytest.mark.parametrize(("frames", "most"), [(1, 4), (2, 3), (3, 2), (4, 1)])
def test_the_explanation_is_the_cheapest_of_all(frames, most, block):
    """Oracle: every explanation written out, each with its likelihood ratio multiplied up from densities: the least
    cost, an explanation that is among them, and its own cost. 50 random windows in each of 20 blocks."""
    used = {"old": 0, "new": 0}
    for seed in range(50):
        rng = np.random.default_rng([frames, block, seed])
        mda, glances = random_mda(rng, max(2, frames)), random_glances(rng, frames, most)
        keys, assigned = mda.explain_window(glances, VIEW)
        every = list(explanations(glances))
        assert keys in every
        assert assigned.exact and assigned.cost == pytest.approx(cost_of(mda, glances, keys), abs=1e-9)
        assert assigned.cost == pytest.approx(min(cost_of(mda, glances, e) for e in every), abs=2e-6)
        used["old"] += sum(key[0] == -1 for row in keys for key in row)
        used["new"] += sum(key[0] >= 0 for row in keys for key in row)
    assert used["old"] > 20 and (frames == 1 or used["new"] > 10)


def two_views(squared, link, *, trial=True, missed=0.0) -> list[Glance]:
    """Landmark 0, and two frames with sightings at squared[0], squared[1] from it; link (M0, M1) between them."""
    glances = []
    for f, each in enumerate(squared):
        d = np.array(each, dtype=float)[:, None]
        links = () if f == 0 else ((np.array(link, dtype=float), np.full((len(squared[0]), len(d)), -11.0)),)
        glances.append(
            Glance(np.array([0]), d, np.full(d.shape, -11.0), np.array([trial]), np.array([missed]), 1, GATE,
                   NEW_GATE, links)
        )  # fmt: skip
    return glances


def test_explanations_by_hand():
    """Oracle: by hand, with pairs that cost about -9 and 1/2 more for each squared distance: the second frame tells
    a landmark's neighbour from it; two in a row are new; one alone is false; a landmark that is believed in lets
    nothing near it be new."""
    mda = Mda()
    assert mda.explain_window(two_views([[4.0, 1.0], []], np.zeros((2, 0))), VIEW)[0] == [
        [UNUSED, (-1, 0)],
        [],
    ]
    seen_again = two_views([[4.0, 1.0], [0.0, 9.0]], [[0.0, 90.0], [90.0, 0.0]])
    assert mda.explain_window(seen_again, VIEW)[0] == [[(-1, 0), (0, 1)], [(-1, 0), (0, 1)]]
    believed = two_views([[4.0, 1.0], [0.0, 9.0]], [[0.0, 90.0], [90.0, 0.0]], trial=False)
    assert mda.explain_window(believed, VIEW)[0] == [[UNUSED, (-1, 0)], [(-1, 0), UNUSED]]
    far = two_views([[90.0], [90.0]], [[1.0]])
    assert mda.explain_window(far, VIEW)[0] == [[(0, 0)], [(0, 0)]]
    assert mda.explain_window(two_views([[90.0], [90.0]], [[10.0]]), VIEW)[0] == [[UNUSED], [UNUSED]]


def test_seen_twice_counts_no_more_than_two_seen_once():
    """Oracle: by hand: whether one of two landmarks is missed twice or each once is the same probability, so the
    distances alone decide in each frame."""
    glances = [
        Glance(np.array([0, 1]), np.array([pair]), np.full((1, 2), -11.0), np.zeros(2, bool), np.full(2, 2.3), 2,
               GATE, NEW_GATE, () if f == 0 else ((np.array([[0.0]]), np.array([[-11.0]])),))
        for f, pair in enumerate([[1.0, 1.2], [1.2, 1.0]])
    ]  # fmt: skip
    assert Mda().explain_window(glances, VIEW)[0] == [[(-1, 0)], [(-1, 1)]]


def test_so_many_that_the_least_likely_are_left_out(monkeypatch):
    """Oracle: by hand: 90 landmarks and two frames of 90, all in one place but for a hair: every sighting is
    explained, by the landmark it lies nearest to, and not by trying 745,000 tuples."""
    plain, tried = mda_module.solve_assignment, []
    monkeypatch.setattr(
        mda_module, "solve_assignment", lambda *given, **more: tried.append(given[0]) or plain(*given, **more)
    )
    count = 90
    rng = np.random.default_rng(3)
    order = [rng.permutation(count) for _ in range(2)]
    glances = [
        Glance(np.arange(count), np.where(order[f][:, None] == np.arange(count), 0.0, 1.0),
               np.full((count, count), -11.0), np.zeros(count, bool), np.full(count, 2.3), count, GATE, NEW_GATE,
               () if f == 0 else ((np.zeros((count, count)), np.full((count, count), -11.0)),))
        for f in range(2)
    ]  # fmt: skip
    keys, assigned = Mda().explain_window(glances, VIEW)
    assert keys == [[(-1, n) for n in each.tolist()] for each in order] and assigned.exact
    assert 0 < len(tried[0]) <= 200_000


def test_tracks_of_five_frames_in_one_place():
    """Oracle: by hand: twelve things seen in five frames, all within the gate of each other but nearest to
    themselves: twelve tracks."""
    count, frames = 12, 5
    apart = np.where(np.eye(count, dtype=bool), 0.0, 4.0)
    volume = np.full((count, count), -11.0)
    glances = [
        Glance(np.zeros(0, int), np.zeros((count, 0)), np.zeros((count, 0)), np.zeros(0, bool), np.zeros(0), 0, GATE,
               NEW_GATE, ((apart, volume),) * f)
        for f in range(frames)
    ]  # fmt: skip
    keys, _ = Mda(window=5).explain_window(glances, VIEW)
    assert keys == [[(0, i) for i in range(count)]] * frames


# --- carrying a decision through ------------------------------------------------------------------


def test_a_decision_is_carried_out_by_hand():
    """Oracle: by hand: 0 is believed, 1 and 2 are on trial. What is wanted happens whatever the distances; the rest
    of the newest frame goes to a landmark on trial that is free, founds one where nothing is near, and is a false
    alarm beside what is taken or believed; of an older frame the rest is false."""
    mda = Mda()
    memory = memory_of(mda, 3)
    decide_seen(mda, memory)
    squared = [
        [90.0, 2.0, 90.0],
        [90.0, 1.0, 90.0],
        [90.0, 90.0, 3.0],
        [90.0] * 3,
        [3.0, 90.0, 90.0],
        [90.0] * 3,
    ]
    wanted = [1, SPURIOUS, SPURIOUS, SPURIOUS, SPURIOUS, NEW]
    for newest, expected in (
        (True, [1, SPURIOUS, 2, NEW, SPURIOUS, NEW]),
        (False, [1, *[SPURIOUS] * 4, NEW]),
    ):
        predicted = Fake(squared)
        predicted.explain = True
        association = mda.conclude(memory, frame(6), predicted, wanted, newest, ("why",))
        assert association.matched.tolist() == expected
        reasons = association.why.reasons.tolist()
        assert reasons[0] == Reason.WINDOW and reasons[5] == Reason.FOUNDED
        assert reasons[1] == reasons[4] == Reason.FALSE_ALARM and association.why.notes == ("why",)
        assert (reasons[2], reasons[3]) == (
            (Reason.NEAREST, Reason.FOUNDED) if newest else (Reason.FALSE_ALARM,) * 2
        )
        assert set(association.confirmed) == ({1, 2} if newest else {1})


def decide_seen(mda: Mda, memory) -> None:
    """Landmark 0 is seen a second time and so believed."""
    association = mda.conclude(memory, frame(1), Fake([[1.0, 90.0, 90.0]]), [0], False)
    mda.settle(memory, association)
    assert memory["confirmed"] == [True, False, False]


def test_what_is_wanted_but_not_there_is_false():
    """Oracle: by hand: a landmark outside the region cannot be given to a sighting."""
    mda = Mda()
    memory = memory_of(mda, 2)
    predicted = Fake([[90.0, 90.0]])
    predicted.within = lambda reach, front: np.array([0])
    assert mda.conclude(memory, frame(1), predicted, [1], False).matched.tolist() == [SPURIOUS]
    assert mda.conclude(memory, frame(1), predicted, [1], True).matched.tolist() == [NEW]


def test_a_frame_by_itself():
    """Oracle: by hand: the seam's own question, without a window: the nearest inside the gate, one-to-one."""
    mda = Mda()
    memory = memory_of(mda, 3)
    decide_seen(mda, memory)
    predicted = Fake([[3.0, 90.0, 90.0], [1.0, 90.0, 90.0], [90.0, 90.0, 90.0]])
    assert decide(mda, memory, frame(3), predicted).matched.tolist() == [SPURIOUS, 0, NEW]


def test_attributes_tell_sightings_apart():
    """Oracle: by hand: squared deviation over twice the variance of one; what is unknown adds nothing."""
    mda = Mda(attributes=(Attribute(name="size", sigma=0.1), Attribute(name="kind", classes=True, sure=0.9)))
    one = Sightings(0.0, np.ones((3, 2)), attributes={"size": [0.5, 0.7, math.nan], "kind": [1.0, 2.0, 1.0]})
    two = Sightings(0.0, np.ones((2, 2)), attributes={"size": [0.5, math.nan], "kind": [1.0, 1.0]})
    other_kind = 2.0 * math.log(9.0)
    expected = [[0.0, 0.0], [0.04 / 0.02 + other_kind, other_kind], [0.0, 0.0]]
    np.testing.assert_allclose(mda.told_apart(one, two), expected, atol=1e-12)
    assert Mda().told_apart(one, two).tolist() == [[0.0, 0.0]] * 3


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [("window", 1), ("window", 0), ("detection", 0.0), ("detection", 1.0), ("detection", math.nan),
     ("false_rate", 0.0), ("false_rate", -1.0), ("new_rate", 0.0), ("new_rate", math.inf), ("new_rate", math.nan),
     ("work", 0), ("gate", 2.0)],
)  # fmt: skip
def test_impossible_settings_are_refused(name, value):
    """Oracle: ConfigError naming the setting."""
    with pytest.raises(ConfigError, match=name):
        Mda(**{name: value})
