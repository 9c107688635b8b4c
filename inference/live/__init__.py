"""Beliefs that follow measurements while they are made.

    from bcppl.inference.live import Filter, play

    with Filter(model, recording_without_measurements) as live:
        for measurement in play(recording):  # or from a robot's callback
            live.observe(*measurement)
        print(live.settle().belief.mean)

`Filter` assimilates measurements in a thread of its own; `Sampler` makes windows of a probe from messages of
a wrist sensor and of an arm; `play` yields a recording's measurements when they were made.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
