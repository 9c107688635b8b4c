"""Series with static parameters, and their smoothing: two programs of a series, a kernel, a step, a verb.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import markov_chains
    from bcppl.inference.kernels import metropolis_hastings
    from bcppl.inference.proposals import drift
    from bcppl.inference.series import marginal
    from bcppl.traces import Series, generate

    def init():
        rate = pyro.sample("rate", dist.Normal(torch.tensor(0.0).double(), 1.0))
        return {"rate": rate, "x": pyro.sample("x", dist.Normal(0.0, 1.0))}

    def step(state):
        x = pyro.sample("x", dist.Normal(state["x"] + state["rate"], 0.5))
        pyro.sample("y", dist.Normal(x, 0.3))
        return {"rate": state["rate"], "x": x}

    program = marginal(Series(init, step), "rate", observed="y", particles=50)
    seen = {f"y/{t}": torch.tensor(0.4 * t) for t in range(1, 6)}
    start, _ = generate(program, ([()] * 5,), seen, 20)
    chains = markov_chains(metropolis_hastings(drift("rate")), start, 20)  # PMMH, 20 chains at once

What `init` samples and every state keeps is a static parameter. `marginal` is the program of the parameters
alone, its likelihood estimated by particle filters: Metropolis-Hastings on it is PMMH, SMC on it SMC^2.
`unrolled(series)` is one program with an address for each step: kernels move paths, `particle_gibbs` as a
whole. `auxiliary` is a filter's step with a proposal and a prediction; `smooth` draws whole paths from what a
filter yields.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
