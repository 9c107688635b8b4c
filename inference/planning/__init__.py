"""Motion planning of touches, searches and insertions around a belief over the part's pose.

    import torch
    from bcppl import Belief
    from bcppl.inference.planning import three_two_one
    from bcppl.models.worlds import bench_scene

    bench = bench_scene(3)  # a simulated part with a hole, and a peg
    poses = torch.from_numpy(bench.truth).expand(4, 7).clone()
    plan = three_two_one(Belief(poses, torch.zeros(4).double()), bench.part, bench.peg)
    print(f"{plan.times[-1]:.1f} s of touches that fix all six axes")

A plan is a `bcppl.Plan`: motions that are free, guarded, held or searching.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
