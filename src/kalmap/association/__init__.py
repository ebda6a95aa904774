"""Data association: which landmark a sighting belongs to."""

from kalmap.association.associator import Associator, Expected, Predicted
from kalmap.association.attributes import Attribute
from kalmap.association.djnn import Djnn
from kalmap.association.gated import Gated
from kalmap.association.jcbb import Jcbb
from kalmap.association.known import KnownIds
from kalmap.association.local import Region
from kalmap.association.management import Counter, Existence, Keep, Trial
from kalmap.association.mda import Mda
from kalmap.association.merging import Merging
from kalmap.association.nearest import Likelihood, Nearest
from kalmap.association.pmb import Pmb

__all__ = [
    "Associator",
    "Attribute",
    "Counter",
    "Djnn",
    "Existence",
    "Expected",
    "Gated",
    "Jcbb",
    "Keep",
    "KnownIds",
    "Likelihood",
    "Mda",
    "Merging",
    "Nearest",
    "Pmb",
    "Predicted",
    "Region",
    "Trial",
]
