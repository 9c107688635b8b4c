"""Convex pieces of solids: covers of regions, decompositions of meshes, and how far they are off."""
