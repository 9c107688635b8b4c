"""A page of a run, or of a recording: bodies and particles in space, in step with what was measured.

    page = bcppl.view(recording, [(step.info.label, step.belief) for step in steps])
    page.save("run.html")  # and `page` alone at the end of a notebook's cell shows it there

The page is one file of HTML that asks nothing of any other host. What it shows of a kind of measurement is
registered with `bcppl.viewer.of_measurements.shown`.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
