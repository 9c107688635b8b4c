"""Likelihoods of the kinds of measurement: models choose among them, each prepared from one recording."""
