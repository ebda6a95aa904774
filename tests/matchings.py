"""All associations of a frame, written out."""

from __future__ import annotations

import itertools


def matchings(sightings, landmarks):
    """Every way to give sightings landmarks one to one: tuples of a landmark or -1."""
    for given in itertools.product(range(-1, landmarks), repeat=sightings):
        used = [j for j in given if j >= 0]
        if len(used) == len(set(used)):
            yield given
