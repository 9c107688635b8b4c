"""Bayesian experimental design: candidates for the next measurement, ranked by expected information gain.

    from bcppl.inference import initialize
    from bcppl.inference.design import expected_information_gain, mixture_entropy
    from bcppl.models import load_recording
    from bcppl.models.point_probe import model

    recording = load_recording("point_probe_10_pushes")
    scene, pushes = model.prepare(recording), [each.action for each in recording.measurements]
    population = initialize(model, scene, particles=50)
    print(
        expected_information_gain(
            population, pushes[:2], lambda push: (scene, [push]), mixture_entropy("part"), outer_samples=5
        )
    )

`probing_loop` ranks, executes the best and assimilates what it measured.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
