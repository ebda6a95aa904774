"""What associators by place remember of their landmarks, counted by hand."""

from __future__ import annotations

import msgspec
import numpy as np

from fake_map import Fake, decide, frame, memory_of
from kalmap.association import Counter, Djnn, Likelihood, Merging, Nearest, Trial
from kalmap.records import NEW, SPURIOUS


def test_confirmation_and_retirement_by_hand():
    """Oracle: counted by hand: two sightings within three frames in view, or out."""
    method, far = Likelihood(management=Trial(confirm=2, window=3)), 1e3
    memory = memory_of(method, 3)
    assert memory["confirmed"] == [False] * 3
    association = decide(method, memory, frame(1), Fake([[0.1, far, far]], view=[1, 1, 0]))
    assert association.confirmed == (0,) and association.retired == ()
    assert memory["confirmed"] == [True, False, False]
    association = decide(method, memory, frame(1), Fake([[far, far, far]], view=[1, 1, 0]))
    assert association.retired == (1,) and association.matched.tolist() == [NEW]
    assert memory["serial"] == [0, 2, 3] and memory["confirmed"] == [True, False, False]


def test_an_unseen_landmark_behind_another_is_not_missed():
    """Oracle: by hand: the counter falls where a landmark should be seen, and not where something stands before it."""
    for hides, retired in ((False, (1,)), (True, ())):
        method = Djnn()
        memory, predicted = memory_of(method, 2), Fake([[1.0, 90.0]])
        predicted.hidden = lambda expected, h=hides: np.array([False, h])
        assert decide(method, memory, frame(1), predicted).retired == retired


def test_whether_landmarks_hide_each_other_is_learned():
    """Oracle: by hand: with one of two behind something seen in n frames they hide each other while
    n <= 0.3 (2 n + 20), up to fifteen; from the seventeenth frame on the unseen one is missed. Those on trial teach
    nothing."""
    for management, misses in ((Counter(expel=-99, admit=1), True), (Counter(expel=-99, admit=99), False)):
        method = Djnn(management=management)
        memory = memory_of(method, 2)
        for number in range(1, 21):
            predicted = Fake([[1.0, 90.0]])
            predicted.hidden = lambda expected: np.ones(2, dtype=bool)
            decide(method, memory, frame(1), predicted)
            assert memory["score"][1] == 1.0 - max(0, number - 16) * misses
        assert memory["hiding"] == ([20.0, 40.0] if misses else [0.0, 0.0])


def test_an_undecided_sighting_excuses_only_landmarks_that_it_may_show():
    """Oracle: counted by hand: between two landmarks it is left unused and neither is missed; one in whose gate (13.8)
    it does not lie is, though it lies inside the wide gate for new ones (27.6), also if that is why it is unused."""
    method = Likelihood(ambiguity=4.6, management=Counter(expel=-99, admit=1))
    memory = memory_of(method, 3)
    association = decide(method, memory, frame(1), Fake([[1.0, 1.2, 20.0]]))
    assert association.matched.tolist() == [SPURIOUS] and memory["score"] == [1.0, 1.0, 0.0]
    association = decide(method, memory, frame(1), Fake([[20.0, 13.9, 27.0]]))
    assert association.matched.tolist() == [SPURIOUS] and memory["score"] == [0.0, 0.0, -1.0]


def test_nobody_is_on_trial_for_ever():
    """Oracle: by hand: out of view nothing counts, but after `patience` frames it is gone; one that is confirmed in
    that frame stays, and so does one that was before."""
    method = Djnn(patience=3)
    memory, far = memory_of(method, 3), 1e3
    decide(method, memory, frame(1), Fake([[0.1, far, far]], view=[1, 0, 0]))
    for _ in range(2):
        assert decide(method, memory, frame(0), Fake(np.zeros((0, 3)), view=[0, 0, 0])).retired == ()
    association = decide(method, memory, frame(1), Fake([[far, 0.1, far]], view=[0, 0, 0]))
    assert association.retired == (2,) and association.confirmed == (1,)
    assert memory["serial"] == [0, 1] and memory["confirmed"] == [True, True]
    for _ in range(9):
        assert decide(method, memory, frame(0), Fake(np.zeros((0, 2)), view=[0, 0])).retired == ()


def test_what_two_landmarks_had_the_one_has():
    """Oracle: by hand: 2 becomes 0: the higher score stays, the lists close up."""
    method = Nearest(management=Counter(), merging=Merging())
    memory = memory_of(method, 3)
    memory["score"] = [2.0, 5.0, 7.0]
    nothing = method.associate(memory, frame(0), Fake(np.zeros((0, 3)), view=[0, 0, 0]))
    method.settle(memory, msgspec.structs.replace(nothing, merged=((0, 2),), retired=()))
    assert memory["score"] == [7.0, 5.0] and memory["serial"] == [0, 1]
