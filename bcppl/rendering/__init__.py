"""Depth images of parts at many poses: rays, triangles, scenes, and the noise of a depth sensor."""
