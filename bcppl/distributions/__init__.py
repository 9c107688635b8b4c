"""Pose priors, and likelihoods of images, contacts, wrenches and touches.

All raise `bcppl.errors.InputError` where a parameter is out of its range, where a shape does not fit, and
likelihoods of images where a pose or another latent value is not finite.
"""
