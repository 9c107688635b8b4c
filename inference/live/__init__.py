"""Beliefs that follow measurements while they are made.

    from dataclasses import replace

    from bcppl.inference.live import Filter, play
    from bcppl.models import load_recording
    from bcppl.models.point_probe import model

    recording = load_recording("point_probe_10_pushes")
    known = replace(recording, measurements=[])  # the part, and a guess of where it is
    with Filter(model, known, particles=10) as live:
        for measurement in play(replace(recording, measurements=recording.measurements[:1]), speed=10.0):
            live.observe(measurement.action, measurement.observation)  # in a robot's callback
        print(live.settle().belief.mean)

`Filter` assimilates measurements in a thread of its own; `Sampler` makes windows of a probe from messages of
a wrist sensor and of an arm; `play` yields a recording's measurements when they were made.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
