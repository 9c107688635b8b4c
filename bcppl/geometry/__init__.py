"""Geometry: parts, cameras, outlines, convex decompositions and signed distances, without simulation."""
