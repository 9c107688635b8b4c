from bcppl.inference.design.entropies import (
    Entropy as Entropy,
    EntropyOf as EntropyOf,
    mode_entropy as mode_entropy,
    neighbour_entropy as neighbour_entropy,
    value_entropy as value_entropy,
    weight_entropy as weight_entropy,
)
from bcppl.inference.design.expected_entropy import expected_information_gain as expected_information_gain
from bcppl.inference.design.linearised import linearised_information_gain as linearised_information_gain
from bcppl.inference.design.loop import Round as Round, World as World, probing_loop as probing_loop
from bcppl.inference.design.observations import Batched as Batched
from bcppl.inference.design.ranking import Prospect as Prospect, Ranking as Ranking
from bcppl.inference.design.rules import (
    Rank as Rank,
    at_random as at_random,
    by_information as by_information,
    by_largest_variance as by_largest_variance,
    by_reweighing as by_reweighing,
)
