"""Traces: runs of a program for N particles at once, and the verbs on them."""
