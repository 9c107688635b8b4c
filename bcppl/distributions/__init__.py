"""Pose priors, and likelihoods of images, contacts, wrenches and touches."""
