"""Pose priors, and likelihoods of images, contacts, wrenches and touches.

    import pyro
    import torch
    from bcppl.distributions.poses import NormalPose, UniformPose
    from bcppl.poses import identity
    from bcppl.traces import generate

    def seen():
        part = pyro.sample("part", UniformPose(identity(), translation=0.02, angle=0.2))
        pyro.sample("camera", NormalPose(part, covariance=1e-6 * torch.eye(6).double()))

    trace, log_weight = generate(seen, (), {"camera": identity()}, particles=1000)
    print(trace["part"].shape, log_weight.max())  # x y z (m) qw qx qy qz

`poses` has priors of poses; `depth`, `touch` and `contact` have likelihoods of what sensors measure.

All raise `bcppl.errors.InputError` where a parameter is out of its range, where a shape does not fit, and
likelihoods of images where a pose or another latent value is not finite.
"""
