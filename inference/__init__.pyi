from bcppl.inference import (
    annealing as annealing,
    calibration as calibration,
    chains as chains,
    collectors as collectors,
    criticism as criticism,
    design as design,
    kernels as kernels,
    learning as learning,
    live as live,
    planning as planning,
    proposals as proposals,
    resampling as resampling,
    saved as saved,
    series as series,
    structures as structures,
    summaries as summaries,
    targets as targets,
)
from bcppl.inference.arviz import to_arviz as to_arviz
from bcppl.inference.calibration.kernel_check import check_kernel as check_kernel
from bcppl.inference.chains import Chains as Chains, markov_chains as markov_chains
from bcppl.inference.collectors import collect as collect
from bcppl.inference.filters import (
    bayes_contact as bayes_contact,
    guided_smc as guided_smc,
    tempered_smc as tempered_smc,
)
from bcppl.inference.filters.default import infer as infer
from bcppl.inference.filters.smc import Info as Info, Step as Step, smc as smc
from bcppl.inference.filters.smcp3 import Pair as Pair, smcp3 as smcp3
from bcppl.inference.filters.step import (
    Observed as Observed,
    StepInfo as StepInfo,
    Stepped as Stepped,
    steps as steps,
)
from bcppl.inference.filters.tempering import tempered as tempered
from bcppl.inference.filters.waste_free import waste_free_moves as waste_free_moves
from bcppl.inference.importance import (
    generate_stratified as generate_stratified,
    importance_sampling as importance_sampling,
    tempered_importance_sampling as tempered_importance_sampling,
)
from bcppl.inference.learning import adaptive_hmc as adaptive_hmc, train as train
from bcppl.inference.population import Population as Population
from bcppl.inference.progress import watched as watched
from bcppl.inference.repetitions import Repeated as Repeated, repeated as repeated
from bcppl.inference.sizing import merge as merge, replicate as replicate, resize as resize
from bcppl.inference.summaries import evidence_variance as evidence_variance
from bcppl.inference.verbs import (
    initialize as initialize,
    observations_of as observations_of,
    rejuvenate as rejuvenate,
    resample as resample,
    update as update,
)
