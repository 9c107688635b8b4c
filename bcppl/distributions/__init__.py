"""Pose priors, and likelihoods of depth images and contacts."""
