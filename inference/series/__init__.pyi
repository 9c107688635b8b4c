from bcppl.inference.series.auxiliary_filters import auxiliary as auxiliary
from bcppl.inference.series.conditional import particle_gibbs as particle_gibbs
from bcppl.inference.series.marginalised import (
    SeriesLikelihood as SeriesLikelihood,
    marginal as marginal,
)
from bcppl.inference.series.smoothing import smooth as smooth
from bcppl.inference.series.unrolling import unrolled as unrolled
