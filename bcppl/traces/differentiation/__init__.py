"""Gradients through programs and the verbs."""
