"""Data association: which landmark a sighting belongs to."""

from kalmap.association.associator import Associator, Predicted
from kalmap.association.known import KnownIds
from kalmap.association.likelihood import Likelihood

__all__ = ["Associator", "KnownIds", "Likelihood", "Predicted"]
