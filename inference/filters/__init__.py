"""Filters: sequential Monte Carlo over measurements, and the steps that it is made of."""
