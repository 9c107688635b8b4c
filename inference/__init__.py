"""Inference programs and the pieces they are made of."""
