"""Depth images of parts at many poses: ray casting, rasterisation, occlusion, and a depth sensor's noise."""
