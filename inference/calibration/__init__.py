"""Whether an inference is calibrated, in one call: for any program that can be simulated.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.calibration import Joint, calibrate, ranks_figure

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    def inference(data):
        return importance_sampling(weighed, (), data, particles=200)

    calibration = calibrate(Joint(weighed, (), ["reading"]), inference, draws=25)
    print(calibration)  # a p-value for every test quantity, and coverage
    ranks_figure(calibration).savefig("calibration.png")

`Recorded(model)` takes recordings that a model's own world simulates. Rounds run in several processes, and
are kept in a folder: see `calibrate`.
"""

from bcppl.inference.calibration.figure import ranks_figure
from bcppl.inference.calibration.joint import Densities, Drawn, Joint, Prior, Recorded, Simulator
from bcppl.inference.calibration.kernel_check import KernelCheck, KernelError, check_kernel
from bcppl.inference.calibration.result import Averaged, Calibration
from bcppl.inference.calibration.simulation_based import calibrate

__all__ = [
    "Averaged",
    "Calibration",
    "Densities",
    "Drawn",
    "Joint",
    "KernelCheck",
    "KernelError",
    "Prior",
    "Recorded",
    "Simulator",
    "calibrate",
    "check_kernel",
    "ranks_figure",
]
