"""Geometry: parts, cameras, outlines, convex pieces and distances; nothing here is simulated."""
