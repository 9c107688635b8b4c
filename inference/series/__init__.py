"""Series with static parameters, and their smoothing: two programs of a series, a kernel, a step, a verb.

A series is a pair of programs `Series(init, step)` (`bcppl.traces.series`). What `init` samples and every
state keeps is a static parameter.

    def init():
        drift = pyro.sample("drift", dist.Normal(0.0, 1.0))
        return {"drift": drift, "x": pyro.sample("x", dist.Normal(0.0, 1.0))}

    def step(state):
        x = pyro.sample("x", dist.Normal(state["x"] + state["drift"], 0.5))
        pyro.sample("y", dist.Normal(x, 0.3))
        return {"drift": state["drift"], "x": x}

`unrolled(series)` is one program with an address for each step: kernels move paths, `particle_gibbs` as a
whole. `marginal(series, "drift", ...)` has the parameters alone, its likelihood estimated by particle
filters: Metropolis-Hastings on it is PMMH, SMC on it SMC^2. `auxiliary` is a filter's step with a proposal
and a prediction; `smooth` draws whole paths from what a filter yields.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
