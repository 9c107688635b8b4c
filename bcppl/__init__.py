"""bcppl: finding where a part is by looking at it and touching it.

    import bcppl

    recording = bcppl.models.load_recording("point_probe_10_pushes")
    model = bcppl.models.point_probe.model
    for step in bcppl.infer(model, recording, particles=75, seed=0):
        print(step.info.label, step.belief.mean, step.belief.spread)

Whatever is named here is imported when it is first used.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
