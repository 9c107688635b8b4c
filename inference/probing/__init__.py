"""Where to touch next: candidates ranked by how much each is expected to tell."""

from bcppl.inference.probing.entropies import (
    Entropy,
    EntropyOf,
    mode_entropy,
    neighbour_entropy,
    value_entropy,
    weight_entropy,
)
from bcppl.inference.probing.expected_entropy import expected_information_gain
from bcppl.inference.probing.linearised import linearised_information_gain
from bcppl.inference.probing.observations import Batched
from bcppl.inference.probing.ranking import Prospect, Ranking

__all__ = [
    "Batched",
    "Entropy",
    "EntropyOf",
    "Prospect",
    "Ranking",
    "expected_information_gain",
    "linearised_information_gain",
    "mode_entropy",
    "neighbour_entropy",
    "value_entropy",
    "weight_entropy",
]
