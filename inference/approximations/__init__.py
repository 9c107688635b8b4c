"""Approximations of a pose's posterior that guide proposals: Gaussians of images, quadratics of touches."""
