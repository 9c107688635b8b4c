from bcppl.inference.design.entropies import (
    Entropy as Entropy,
    EntropyOfWeights as EntropyOfWeights,
    discrete_entropy as discrete_entropy,
    mixture_entropy as mixture_entropy,
    neighbour_entropy as neighbour_entropy,
    weight_entropy as weight_entropy,
)
from bcppl.inference.design.expected_entropy import expected_information_gain as expected_information_gain
from bcppl.inference.design.linearised import linearised_information_gain as linearised_information_gain
from bcppl.inference.design.loop import Round as Round, World as World, probing_loop as probing_loop
from bcppl.inference.design.observations import BatchedArguments as BatchedArguments
from bcppl.inference.design.ranking import Ranking as Ranking, Utility as Utility
from bcppl.inference.design.relative_mixture import HeldPeg as HeldPeg
from bcppl.inference.design.rules import (
    AcquisitionRule as AcquisitionRule,
    at_random as at_random,
    by_linearised_gain as by_linearised_gain,
    by_reweighted_gain as by_reweighted_gain,
    by_surface_variance as by_surface_variance,
)
