"""Criticism of a model, given its posterior: predictive checks, rival hypotheses, and what is left open.

from bcppl.inference.criticism.predictive import surprise

checks = surprise(population)  # by site: p values of its measurement
"""
