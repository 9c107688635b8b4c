"""Moves across structures against exact draws of the posterior, with mutants of the acceptance ratio."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference import evidence_variance, markov_chains, rejuvenate, resize
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.structures import (
    Jump,
    Strata,
    generate_strata,
    in_turn,
    jump,
    jumps,
    probabilities,
    resample_strata,
    tempered_strata,
    translate,
    translation,
    within,
)
from bcppl.inference.structures.translation import sampling_nothing
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Structure, Trace, generate, structural
from tests.inference.filters.smcp3_programs import flat, silent, turned_over
from tests.inference.kernels.exact_targets import CENTER, WIDE
from tests.inference.structures.structural_programs import (
    EVIDENCES,
    POSTERIOR_OF_COUNT,
    PRIOR,
    SEEN,
    SPREADS,
    birth,
    exact_strata,
    fewer,
    merged,
    more,
    nudge,
    split,
    summed,
    terms_given,
)
from tests.invariance import largest_z, matrix, number


def proposed(trace: Trace) -> None:
    """A term that is proposed given the others; the other program has nothing to choose."""
    count = len(trace.choices)
    rest = torch.stack([trace[f"term_{j}"] for j in range(count)]).sum(dim=0)
    pyro.sample(f"term_{count}", dist.Normal(0.5 * (1.2 - rest), 1.1))


def split_vector(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """One entry, drawn, is halved, with a remainder, and the other part is put last."""
    terms = trace["terms"]
    which = pyro.sample("which", dist.Categorical(torch.ones(terms.shape[1], dtype=torch.float64)))
    part = pyro.sample("part", dist.Normal(number(0.0), 0.8))
    chosen = torch.nn.functional.one_hot(which, terms.shape[1]).to(torch.float64)
    half = (terms * chosen).sum(dim=1) / 2
    return {"terms": torch.cat([terms - chosen * (half - part)[:, None], (half - part)[:, None]], dim=1)}, {
        "which": which
    }


def merge_vector(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    terms, last = trace["terms"][:, :-1], trace["terms"][:, -1]
    which = pyro.sample("which", dist.Categorical(torch.ones(terms.shape[1], dtype=torch.float64)))
    chosen = torch.nn.functional.one_hot(which, terms.shape[1]).to(torch.float64)
    part = ((terms * chosen).sum(dim=1) - last) / 2
    return {"terms": terms + chosen * last[:, None]}, {"which": which, "part": part}


def as_vector(strata: Strata) -> Strata:
    """The same particles of a program whose terms are one vector, as long as there are terms."""

    def program(places: int) -> None:
        count = structural("count", dist.Categorical(PRIOR)) + 1
        spread = matrix(SPREADS[:count])
        terms = pyro.sample("terms", dist.Normal(torch.zeros_like(spread), spread).to_event(1))
        with pyro.plate("places", places):
            pyro.sample("y", dist.Normal(terms.sum(dim=1), 1.0))

    parts = []
    for structure, each in strata.populations.items():
        terms = torch.stack(list(each.trace.choices.values()), dim=1)
        given = {"y": SEEN, **structure.observations}
        trace, _ = generate(program, (3,), given, len(each), {"terms": terms})
        torch.testing.assert_close(trace.log_prob(), each.trace.log_prob())
        parts.append((structure, each.with_trace(trace)))
    return Strata.of(parts, strata.log_evidence)


def test_a_vector_may_have_another_length_in_each_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    def z() -> float:
        torch.manual_seed(0)
        start = as_vector(exact_strata(20_000))
        strata, _ = jump(Jump(more, fewer, split_vector, merge_vector, check=True))(start, POSTERIOR)
        rows = []
        for each in (start, strata):
            row = torch.zeros(len(start), 5, dtype=torch.float64)
            for structure, population in each.populations.items():
                terms, count = population["terms"], structure["count"]
                row[population.founders, count] = 1.0
                row[population.founders, 3] = terms[:, 0]
                row[population.founders, 4] = terms[:, -1] ** 2
            rows.append(row)
        return largest_z(*rows)

    assert z() < 3.7
    monkeypatch.setattr(translation, "assessed", silent)
    assert z() > 10.0


def around(structure: Structure) -> dict[str, int]:
    return {"count": (structure["count"] + 1) % 3}


def back_around(structure: Structure) -> dict[str, int]:
    return {"count": (structure["count"] - 1) % 3}


AWAY = poses.as_pose([0.3, 0.1, -0.2, 0.8, 0.0, 0.6, 0.0])

MOVES = {
    "split and merge": [birth],
    "birth from a proposal": [Jump(more, fewer, proposed)],
    "birth from the model": [Jump(more, fewer)],
    "the pair the other way round": [Jump(fewer, more, merged, split)],
    "two kinds": [birth, Jump(more, fewer, proposed)],
    "around": [Jump(around, back_around)],
}


def statistics(strata: Strata) -> Tensor:
    """Of every particle, by founder: indicators of the counts, and moments of the terms given the count."""
    rows = torch.zeros(len(strata), 8, dtype=torch.float64)
    for structure, each in strata.populations.items():
        count = structure["count"]
        rows[each.founders, count] = 1.0
        rows[each.founders, 3] = each.trace["term_0"]
        rows[each.founders, 4] = each.trace["term_0"] ** 2
        if count > 0:
            rows[each.founders, 5] = each.trace["term_1"]
            rows[each.founders, 6] = each.trace["term_1"] * each.trace["term_0"]
        if count > 1:
            rows[each.founders, 7] = each.trace["term_2"]
    return rows


def z_after(kinds: list[Jump], particles: int = 20_000) -> float:
    torch.manual_seed(0)
    start = exact_strata(particles)
    strata = start
    for _ in range(2):
        strata, acceptance = jump(*kinds)(strata, POSTERIOR)
    assert len(strata) == len(start) and all(0.02 < share < 1.0 for share in acceptance)
    assert torch.equal(strata.log_weights, torch.zeros(len(start), dtype=torch.float64))
    assert strata.log_evidence == start.log_evidence
    return largest_z(statistics(start), statistics(strata))


@pytest.mark.parametrize("kinds", MOVES.values(), ids=MOVES)
def test_jumps_leave_the_posterior_over_structures_invariant(kinds: list[Jump]) -> None:
    assert z_after([replace(each, check=True) for each in kinds]) < 3.7


@pytest.mark.parametrize(
    ("where", "what", "mutant"),
    [
        (translation, "log_abs_det_jacobian", flat),
        (translation, "log_abs_det_jacobian", turned_over),
        (translation, "assessed", silent),
        (jumps, "math", SimpleNamespace(log=lambda count: 0.0)),
    ],
    ids=["no Jacobian", "its inverse", "no density of the backward choices", "no probability of the reverse"],
)
def test_mutants_do_not(where: object, what: str, mutant: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(where, what, mutant)
    assert z_after([birth]) > 10.0


def test_a_tempered_target_is_left_invariant() -> None:
    """With exponent 0 the prior is: jumps from exact draws of it change nothing on average."""
    torch.manual_seed(0)
    parts, founded = [], 0
    for k, size in enumerate((5000, 3000, 2000)):
        trace, _ = generate(summed, (3,), {"y": SEEN, "count": number(float(k))}, size)
        founders = torch.arange(founded, founded + len(trace))
        parts.append((Structure({"count": k}), Population(trace, torch.zeros(len(trace)), founders=founders)))
        founded += len(trace)
    start = Strata.of(parts, 0.0)
    z = {}
    for exponent in (0.0, 0.5):
        strata = start
        for _ in range(2):
            strata, _ = jump(birth)(strata, Target({"y": exponent}))
        z[exponent] = largest_z(statistics(start), statistics(strata))
    assert z[0.0] < 3.7 and z[0.5] > 10.0


def test_chains_over_structures_reach_the_posterior_from_one_of_them() -> None:
    """Weights stay, so chains that all begin with one term end with the posterior's counts."""
    torch.manual_seed(0)
    move = in_turn(within(metropolis_hastings(nudge)), jump(birth, Jump(more, fewer)))
    strata, shares = exact_strata(6000).given({"count": 0}), []
    for moves in range(24):
        strata, _ = move(strata, POSTERIOR)
        if moves >= 12:
            shares.append([strata.shares.get(Structure({"count": k}), 0.0) for k in range(3)])
    torch.testing.assert_close(matrix(shares).mean(0), POSTERIOR_OF_COUNT, rtol=0.0, atol=0.03)


def test_weights_go_with_their_particles() -> None:
    torch.manual_seed(0)
    start = exact_strata(3000)
    factors = {s: torch.rand(len(p)).double() + 3.0 * s["count"] for s, p in start.populations.items()}
    start = start.reweighed(factors)
    weights = torch.zeros(3000, dtype=torch.float64)
    for each in start.populations.values():
        weights[each.founders] = each.log_weights
    strata, _ = jump(birth)(start, POSTERIOR)
    for each in strata.populations.values():
        assert torch.equal(each.log_weights, weights[each.founders])
    assert strata.log_evidence == start.log_evidence
    assert strata.log_total == pytest.approx(start.log_total)


def other(places: int) -> None:
    """The sum of two terms by itself, with the variance of both."""
    total = pyro.sample("total", dist.Normal(number(0.0), math.hypot(SPREADS[0], SPREADS[1])))
    with pyro.plate("places", places):
        pyro.sample("y", dist.Normal(total, 1.0))


def adding(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    return {"total": trace["term_0"] + trace["term_1"]}, {"share": trace["term_0"]}


def sharing(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    share = pyro.sample("share", dist.Normal(0.3 * trace["total"], 1.0))
    return {"term_0": share, "term_1": trace["total"] - share}, {}


def test_a_trace_translator_between_programs_weighs_what_it_gives() -> None:
    torch.manual_seed(0)
    exact = terms_given(2).sample((20_000,))
    trace, _ = generate(summed, (3,), {"y": SEEN, "count": number(1.0)}, 20_000)
    trace = trace.at({f"term_{j}": exact[:, j].contiguous() for j in range(2)})
    population = Population(trace, torch.zeros(20_000), float(EVIDENCES[1]))
    # The sum's evidence lacks the prior of the count, and is otherwise the same.
    expected = float(EVIDENCES[1]) - math.log(0.3)
    there = translate(population, adding, sharing, other, (3,), {"y": SEEN})
    assert there.log_evidence == pytest.approx(expected, abs=0.03)
    weights = torch.softmax(there.log_weights, 0)
    assert float(weights @ there["total"]) == pytest.approx(float(exact.sum(1).mean()), abs=0.03)
    back = translate(there, sharing, adding, summed, (3,), {"y": SEEN, "count": number(1.0)})
    assert back.log_evidence == pytest.approx(float(EVIDENCES[1]), abs=0.03)


def wrong(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    values, choices = merged(trace)
    return {a: v + 0.1 for a, v in values.items()}, choices


def too_many(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    values, choices = split(trace)
    return {**values, "y": trace["term_0"]}, choices


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Jump(more, fewer, split, wrong), "does not give 'term_0'"),
        (Jump(more, fewer, split), "leaves out the forward choice 'part'"),
        (Jump(lambda s: {"number": 1}, fewer, split, merged), "'number', which is no structural site"),
        (Jump(fewer, more, sampling_nothing, split), "leaves out the forward choice 'part'"),
        (Jump(more, fewer, lambda trace: ({}, {"part": trace["term_0"]}), split), "coordinates too many"),
        (Jump(more, fewer, too_many, merged), "'y', which is no latent"),
        (Jump(more, lambda s: None, split, merged), "does not lead back"),
        (Jump(more, fewer, lambda trace: 3), "returns a int"),
    ],
)
def test_jumps_that_are_wrong_are_refused(kind: Jump, message: str) -> None:
    torch.manual_seed(0)
    with pytest.raises(InputError, match=message):
        jump(kind)(exact_strata(60), POSTERIOR)
    for given in ((), (split,)):
        with pytest.raises(InputError, match="give one Jump or more"):
            jump(*given)


def test_vectors_of_other_lengths_need_programs_and_have_no_common_mean() -> None:
    def vector() -> None:
        count = structural("count", dist.Categorical(torch.ones(2))) + 1
        terms = pyro.sample("terms", dist.Normal(torch.zeros(count), 1.0).to_event(1))
        pyro.sample("y", dist.Normal(terms.sum(-1), 1.0))

    strata = generate_strata(vector, (), {"y": number(1.0)}, 20)
    with pytest.raises(InputError, match=r"a jump from Structure\(count=0\) to .* let `forward` and `back"):
        jump(Jump(lambda s: {"count": 1} if not s["count"] else None, fewer))(strata, POSTERIOR)
    with pytest.raises(InputError, match=r"other shapes in some strata .*\(2,\) in Structure\(count=1\)"):
        strata["terms"]


def test_strata_and_populations_and_kernels_are_not_taken_for_one_another() -> None:
    strata, kernel = exact_strata(20), metropolis_hastings(drift("term_0"))
    population = next(iter(strata.populations.values()))
    for call in (
        lambda: resize(strata, 5),
        lambda: markov_chains(kernel, strata, 2),
        lambda: evidence_variance(strata),
        lambda: rejuvenate(strata, kernel),
    ):
        with pytest.raises(InputError, match="populations"):
            call()
    for call in (lambda: resample_strata(population), lambda: probabilities(population, "count")):
        with pytest.raises(InputError, match="where strata are wanted"):
            call()
    for call in (lambda: tempered_strata(kernel), lambda: in_turn(kernel)):
        with pytest.raises(InputError, match="in place of a move of strata"):
            call()
    assert not hasattr(strata, "nothing") and not hasattr(population, "nothing")


def either() -> None:
    """A pose under one of two priors; both have it at the same address."""
    which = structural("which", dist.Bernoulli(0.4))
    pyro.sample("pose", NormalPose(poses.compose(CENTER, AWAY) if which else CENTER, WIDE))


def shifted(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The pose with its offset from the centre stretched by a factor that is drawn, then carried away."""
    factor = pyro.sample("factor", dist.LogNormal(number(0.4), 0.3))
    tangent = poses.local(CENTER, trace["pose"]) * torch.where(torch.arange(6) < 3, factor[:, None], 1.0)
    return {"pose": poses.compose(poses.retract(CENTER, tangent), AWAY)}, {"factor": 1.0 / factor}


def shifted_back(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    factor = pyro.sample("factor", dist.LogNormal(number(-0.4), 0.3))
    tangent = poses.local(CENTER, poses.compose(trace["pose"], poses.inverse(AWAY)))
    tangent = tangent * torch.where(torch.arange(6) < 3, factor[:, None], 1.0)
    return {"pose": poses.retract(CENTER, tangent)}, {"factor": 1.0 / factor}


def z_of_poses() -> float:
    """The particles draw the prior, from either structure, and so do those that they are moved to."""
    torch.manual_seed(0)
    parts, founded = [], 0
    for which, size in ((0, 12_000), (1, 8_000)):
        structure = Structure({"which": which})
        trace, _ = generate(either, (), structure.observations, size)
        founders = torch.arange(founded, founded + size)
        parts.append((structure, Population(trace, torch.zeros(size), founders=founders)))
        founded += size
    start = Strata.of(parts, 0.0)
    to = Jump(
        lambda s: None if s["which"] else {"which": 1},
        lambda s: {"which": 0} if s["which"] else None,
        shifted,
        shifted_back,
        check=True,
    )

    def read(strata: Strata) -> Tensor:
        rows = torch.zeros(founded, 14, dtype=torch.float64)
        for structure, each in strata.populations.items():
            centre = poses.compose(CENTER, AWAY) if structure["which"] else CENTER
            tangent = poses.local(centre, each.trace["pose"])
            rows[each.founders, 0] = float(structure["which"])
            rows[each.founders, 1:7] = tangent
            rows[each.founders, 7:13] = tangent**2
        return rows

    return largest_z(read(start), read(jump(to)(start, POSTERIOR).strata))


def test_jumps_of_poses_have_the_jacobian_of_the_tangent_space(monkeypatch: pytest.MonkeyPatch) -> None:
    assert z_of_poses() < 3.7
    monkeypatch.setattr(translation, "log_abs_det_jacobian", flat)
    assert z_of_poses() > 6.0
