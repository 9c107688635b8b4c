"""Worlds: what makes recordings up, with parameters of its own that inference is not told."""
