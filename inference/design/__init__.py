"""Where to touch next: candidates ranked by how much each is expected to tell."""

from bcppl.inference.design.entropies import (
    Entropy,
    EntropyOf,
    mode_entropy,
    neighbour_entropy,
    value_entropy,
    weight_entropy,
)
from bcppl.inference.design.expected_entropy import expected_information_gain
from bcppl.inference.design.linearised import linearised_information_gain
from bcppl.inference.design.observations import Batched
from bcppl.inference.design.ranking import Prospect, Ranking

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
